"""The paper's experiments, run by ``python -m experiments``. They use only the package's public names."""
