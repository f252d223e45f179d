"""The clock and the machine: how anything here is timed, and what is said of where."""
