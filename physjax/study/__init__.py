"""What you ask of a scene: closed forms, accuracy, energy."""
