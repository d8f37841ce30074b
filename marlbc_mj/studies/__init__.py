"""Studies: many independent episodes or trainings, and the report that is made from their results."""
