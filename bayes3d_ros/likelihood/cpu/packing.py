# SPDX-License-Identifier: Apache-2.0

"""Vector instructions that LLVM does not find by itself: comparisons as bits, and the members of a set packed together.

Measured: 0.9 ns a ray packed by permutations of whole vectors (AVX2), 2.7 one by one (docs/speed.md).
"""

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from bayes3d_ros.likelihood.cpu.buffers import VECTOR_LANES

# For every set of eight, in bits: the order that has its members first; and how many they are.
_SETS = (np.arange(256)[:, None] >> np.arange(VECTOR_LANES)) & 1
ORDERS = np.argsort(1 - _SETS, axis=1, kind="stable").astype(np.int32).ravel()
MEMBERS = _SETS.sum(1).astype(np.uint64)


@intrinsic
def bits_as_float(context, bits):
    def generate(context, builder, signature, arguments):
        return builder.bitcast(arguments[0], context.get_value_type(types.float32))

    return types.float32(types.int32), generate


@intrinsic
def float_as_bits(context, number):
    def generate(context, builder, signature, arguments):
        return builder.bitcast(arguments[0], context.get_value_type(types.int32))

    return types.int32(types.float32), generate


def _pick(sign):
    """The smaller or the larger of two numbers that are not NaN. LLVM makes scalar code of numba's min and max in
    loops."""

    @intrinsic
    def pick(context, one, other):
        def generate(context, builder, signature, arguments):
            flags = ("nnan", "nsz")
            first = builder.fcmp_ordered(sign, *arguments, flags=flags)
            return builder.select(first, *arguments, flags=flags)

        return types.float32(types.float32, types.float32), generate

    return pick


lesser, larger = _pick("<"), _pick(">")


def _eight(context, builder, array_type, array, first):
    """Eight numbers of an array as one vector."""
    data = context.make_array(array_type)(context, builder, array).data
    element = context.get_data_type(array_type.dtype)
    return builder.bitcast(builder.gep(data, [first]), ir.VectorType(element, VECTOR_LANES).as_pointer())


@intrinsic
def negative(context, array, first):
    """Which of eight numbers of an array are negative: a bit each."""

    def generate(context, builder, signature, arguments):
        numbers = builder.load(_eight(context, builder, signature.args[0], *arguments), align=4)
        return _as_bits(builder, builder.fcmp_ordered("<", numbers, numbers.type(None)))

    return types.uint64(array, first), generate


@intrinsic
def less(context, array, other, first):
    """Which of eight numbers of an array are less than those of another: a bit each."""

    def generate(context, builder, signature, arguments):
        a, b = (
            builder.load(_eight(context, builder, signature.args[k], arguments[k], arguments[2]), align=4)
            for k in range(2)
        )
        return _as_bits(builder, builder.fcmp_ordered("<", a, b))

    return types.uint64(array, other, first), generate


def _permutes(context):
    """Whether the machine that code is made for orders a vector by one instruction."""
    return "+avx2" in context.codegen().magic_tuple()[2].split(",")


def _as_bits(builder, flags):
    return builder.zext(builder.bitcast(flags, ir.IntType(VECTOR_LANES)), ir.IntType(64))


@intrinsic
def pack(context, array, first, orders, bits, target, to):
    """target[to : to + 8] = eight numbers of an array, members of a set (a row of `ORDERS`) first."""

    def generate(context, builder, signature, arguments):
        array, first, orders, bits, target, to = arguments
        kinds = signature.args
        numbers = builder.load(_eight(context, builder, kinds[0], array, first), align=4)
        row = builder.mul(bits, bits.type(VECTOR_LANES))
        order = builder.load(_eight(context, builder, kinds[2], orders, row), align=4)
        if _permutes(context):
            reals = ir.VectorType(ir.FloatType(), VECTOR_LANES)
            permute = cgutils.get_or_insert_function(
                builder.module, ir.FunctionType(reals, [reals, order.type]), "llvm.x86.avx2.permps"
            )
            packed = builder.call(permute, [builder.bitcast(numbers, reals), order])
            packed = builder.bitcast(packed, numbers.type)
        else:
            packed, word = numbers, ir.IntType(32)
            for k in range(VECTOR_LANES):
                one = builder.extract_element(numbers, builder.extract_element(order, word(k)))
                packed = builder.insert_element(packed, one, word(k))
        builder.store(packed, _eight(context, builder, kinds[4], target, to), align=4)
        return context.get_dummy_value()

    return types.void(array, first, orders, bits, target, to), generate
