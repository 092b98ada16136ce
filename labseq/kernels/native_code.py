"""The functions of `labseq.kernels.native` in compiled code. Imported together with numba.

numba looks at the names of arguments, which must agree between a function, its overload and the intrinsic.
"""
# ruff: noqa: ARG001
# pyright: basic, reportCallIssue=false, reportPrivateImportUsage=false

import numba
from llvmlite import ir
from numba.core.types import int64, voidptr
from numba.extending import intrinsic, overload

from labseq.kernels import native

_WORD, _BYTE = ir.IntType(64), ir.IntType(8)
_C_FUNCTION = ir.FunctionType(ir.IntType(32), [_WORD] * 3)


@intrinsic
def _call(context, address, a, b, c):
    def code(context, builder, signature, values):
        builder.fence("seq_cst")  # other threads see writes before and after in order
        result = builder.call(builder.inttoptr(values[0], _C_FUNCTION.as_pointer()), values[1:])
        builder.fence("seq_cst")
        return builder.zext(result, _WORD)

    return int64(int64, int64, int64, int64), code


@overload(native.call_c)
def _call_c(address, a, b, c):
    def call_c(address, a, b, c):
        return _call(address, a, b, c)

    return call_c


@intrinsic
def _point(context, address):
    def code(context, builder, signature, values):
        return builder.inttoptr(values[0], _BYTE.as_pointer())

    return voidptr(int64), code


@overload(native.pointer)
def _pointer(address):
    def pointer(address):
        return _point(address)

    return pointer


@overload(native.carray)
def _carray(pointer, shape, dtype):
    def carray(pointer, shape, dtype):
        return numba.carray(pointer, shape, dtype)

    return carray


@intrinsic
def _exchange(context, address, value):
    def code(context, builder, signature, values):
        word = builder.inttoptr(values[0], _WORD.as_pointer())
        return builder.atomic_rmw("xchg", word, values[1], "seq_cst")

    return int64(int64, int64), code


@overload(native.swap)
def _swap(address, value):
    def swap(address, value):
        return _exchange(address, value)

    return swap
