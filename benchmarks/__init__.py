"""Benchmarks: what was measured to choose models and settings; `python -m benchmarks NAME` from the repository.

Not in the wheel. Each command writes its tables as CSV and Markdown into a folder; docs/measurements.md shows results,
and `notes` tells what was tried and left.
"""
