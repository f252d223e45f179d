"""The self-test of the kernels, which runs on first use of a GPU and finds kernels that do not work there."""

from hyrfpack.self_test.run import SelfTest, is_temporary, run_self_test
from hyrfpack.self_test.store import load_or_run_self_test, load_self_test, store_self_test

__all__ = ["SelfTest", "is_temporary", "load_or_run_self_test", "load_self_test", "run_self_test", "store_self_test"]
