"""What you ask of a scene: accuracy, stability, energy, ablation, sweeps and inverse problems, each with its charts."""
