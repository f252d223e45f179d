"""Measure the run time of operations and settings together with the error that each of them causes."""
