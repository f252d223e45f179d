"""Settings of the stages: frozen dataclasses, from which the checks and the options of the command line are made.

The modules import neither torch nor NumPy, so that the command line lists its options quickly.
"""
