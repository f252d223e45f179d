"""Performance-critical numeric operations. Each is one function with a reference and faster implementations."""
