"""Points on surfaces and low-discrepancy numbers."""
