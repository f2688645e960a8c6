"""Many cases: made, run, scored and put into one table."""
