"""What a report is made of: the folders of runs and batches, and their scenes in three dimensions."""
