"""What acts on a scene: forces now; each is usable under every method."""
