"""What a replay is made of: what it is asked, reads, knows of the scene, does, finds, concludes and writes."""
