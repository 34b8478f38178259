"""A replay: request, inputs, known scene, modes, evidence, verdict and files."""
