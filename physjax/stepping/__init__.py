"""How a scene moves: the methods, the loop that repeats their steps, and the bridge to diffrax."""
