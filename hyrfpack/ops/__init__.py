"""The few hot numeric operations: each one function with a reference and faster implementations behind it."""
