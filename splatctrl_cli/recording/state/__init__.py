"""Joint states and twists from tables, and any record of a motion."""
