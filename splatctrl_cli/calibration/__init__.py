"""Camera poses relative to each other and the robot: residuals, least squares and certainty."""
