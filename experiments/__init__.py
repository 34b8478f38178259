"""The paper's experiments, run by ``python -m experiments``. They use the package's public names alone."""
