"""Digests of what the commands write, kept in digests.txt: whether a change of the code moves a figure."""
