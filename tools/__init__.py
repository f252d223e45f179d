"""What maintainers run, from the repository's root: `python -m tools.<wing>.<name> --help`.

gpu/ checks and measures the GPU kernels, bench/ times operations against references, studies/ are the experiments
behind the documentation's tables, safety/ is what is done to files, readers, processes and versions on purpose.
"""
