"""Whether assessments and recommendations are right: random scenes, long runs, and what comes of the comparison."""
