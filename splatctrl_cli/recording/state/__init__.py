"""Joint states and twists that come in tables, and what opens any record of a motion."""
