"""Measure run times and numerical errors, and describe the machine that they were measured on."""
