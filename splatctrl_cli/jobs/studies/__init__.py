"""Studies: the paper's experiments repeated, each trial published; every study is a batch of problems."""
