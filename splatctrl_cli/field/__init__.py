"""III-D: distance, gradient and probability fields from splats."""
