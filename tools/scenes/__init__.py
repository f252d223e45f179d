"""Generates photo sets of the size that users have, with known poses and geometry: `tools.scenes.write_set`.

Kernels are cached on disk, and Numba does not notice changes in kernels of other files that a kernel calls. So delete
`tools/scenes/__pycache__` after a change of a kernel.
"""
