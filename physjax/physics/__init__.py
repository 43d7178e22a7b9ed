"""What acts on a scene: forces, springs, contacts, rigid bodies and emitters, each usable under every method."""
