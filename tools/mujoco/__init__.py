"""An independent judge: recordings made by MuJoCo, with exact truth, and the answers of `splatctrl`."""
