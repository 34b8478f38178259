"""SplatCtrl: what a robot's cameras recorded, as splats, distance fields and replayed controllers."""

__version__ = "0.1.0"
