"""Digests of the commands' outputs, stored in digests.txt, show if a code change alters a figure."""
