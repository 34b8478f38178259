"""Any recorded input as frames and joint states: logs, captures, folders of images, tables."""
