"""How a scene moves: methods, the loop that repeats them, and the diffrax bridge."""
