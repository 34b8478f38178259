"""How far a recorded run is from the other verdict: what is varied, the search, the runs that answer it."""
