"""An independent judge: recordings made by MuJoCo, with exact truth, and what `splatctrl` says of them."""
