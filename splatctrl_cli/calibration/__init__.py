"""Where cameras stand against each other and the robot, from what they see: residuals, their least squares, and how
sure it is.
"""
