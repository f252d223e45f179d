"""The clock, the machine and the error: how anything here is timed, where, and how far off it is."""
