"""Provides prefetch instructions for compiled kernels that read or write memory out of order."""

from __future__ import annotations

from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import intrinsic


def _prefetch(for_write: int):
    """Make a Numba intrinsic that prefetches the first cache line of an array's row."""

    def typed(typingctx, array, row):
        def codegen(context, builder, signature, args):
            layout = signature.args[0]
            first = context.get_constant(types.uint64, 0)
            line = cgutils.get_item_pointer(
                context, builder, layout, context.make_array(layout)(context, builder, args[0]), [args[1], first]
            )
            byte, number = ir.IntType(8).as_pointer(), ir.IntType(32)
            call = ir.FunctionType(ir.VoidType(), [byte, number, number, number])
            function = cgutils.get_or_insert_function(builder.module, call, "llvm.prefetch.p0")
            keep_close, data = number(3), number(1)
            builder.call(function, [builder.bitcast(line, byte), number(for_write), keep_close, data])
            return context.get_dummy_value()

        return types.void(array, row), codegen

    return intrinsic(typed)


prefetch_row = _prefetch(for_write=0)
"""prefetch_row(array, i) prefetches row i (uint64) of a 2-D array for reading. It reads nothing, so any i is safe."""

prefetch_row_for_write = _prefetch(for_write=1)
"""prefetch_row_for_write(array, i) prefetches row i for writing, and is otherwise like `prefetch_row`."""
