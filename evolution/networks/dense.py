"""Vector code for network layers, with sums held in registers.

`dense` computes some units of a perceptron's layer, `tile` some positions times some units of a convolution. The inputs
of a position are `planes` x `rows` runs of `run` consecutive numbers. The `vector_` variants emit LLVM vectors; the
`plain_` variants do the same arithmetic in plain Python, for `NUMBA_DISABLE_JIT=1` and for tests.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from llvmlite import ir
from numba.core import cgutils, types
from numba.core.extending import intrinsic

from gridsim.jit import CONFIG


def plain_tile(positions: int, lanes: int, rectify: bool) -> Callable[..., None]:
    """A tile in plain Python; see `tile`."""

    def plain(
        x, x_at, x_step, planes, plane_step, rows, row_step, run, w, w_at, width, bias_at, y, y_at, y_step
    ):  # fmt: skip
        for p in range(positions):
            total = w[bias_at : bias_at + lanes].copy()
            at = w_at
            for plane in range(planes):
                for row in range(rows):
                    first = x_at + p * x_step + plane * plane_step + row * row_step
                    for i in range(run):
                        total += x[first + i] * w[at : at + lanes]
                        at += width
            y[y_at + p * y_step : y_at + p * y_step + lanes] = np.where(total < 0.0, 0.0, total) if rectify else total

    return plain


def vector_tile(positions: int, lanes: int, rectify: bool) -> Any:
    """A tile as an intrinsic for kernels; see `tile`."""

    @intrinsic
    def vector(
        typingctx, x, x_at, x_step, planes, plane_step, rows, row_step, run, w, w_at, width, bias_at, y, y_at, y_step
    ):  # fmt: skip
        n = types.int64
        signature = types.void(x, n, n, n, n, n, n, n, w, n, n, n, y, n, n)

        def codegen(context, builder, sig, args):
            f32, i32, i64 = ir.FloatType(), ir.IntType(32), ir.IntType(64)
            vf = ir.VectorType(f32, lanes)
            undefined = ir.Constant(vf, ir.Undefined)

            def data(k: int) -> ir.Value:
                return context.make_array(sig.args[k])(context, builder, args[k]).data

            def vector_at(pointer: ir.Value, at: ir.Value) -> ir.Value:
                return builder.bitcast(builder.gep(pointer, [at]), vf.as_pointer())

            def load(pointer: ir.Value, at: ir.Value) -> ir.Value:
                value = builder.load(vector_at(pointer, at))
                value.align = 4  # a genome is aligned to one float only
                return value

            def splat(value: ir.Value) -> ir.Value:
                single = builder.insert_element(undefined, value, ir.Constant(i32, 0))
                return builder.shuffle_vector(single, undefined, ir.Constant(ir.VectorType(i32, lanes), [0] * lanes))

            inputs, weights, outputs = data(0), data(8), data(12)
            x_at, x_step, planes, plane_step, rows, row_step, run = args[1:8]
            w_at, width, bias_at = args[9:12]
            y_at, y_step = args[13:15]
            totals = [cgutils.alloca_once(builder, vf) for _ in range(positions)]
            bias = load(weights, bias_at)
            for total in totals:
                builder.store(bias, total)
            row_width = builder.mul(run, width)
            with cgutils.for_range(builder, planes, intp=i64) as plane:
                plane_at = builder.add(x_at, builder.mul(plane.index, plane_step))
                plane_w = builder.add(w_at, builder.mul(builder.mul(plane.index, rows), row_width))
                with cgutils.for_range(builder, rows, intp=i64) as row:
                    row_at = builder.add(plane_at, builder.mul(row.index, row_step))
                    row_w = builder.add(plane_w, builder.mul(row.index, row_width))
                    with cgutils.for_range(builder, run, intp=i64) as i:
                        weight = load(weights, builder.add(row_w, builder.mul(i.index, width)))
                        at = builder.add(row_at, i.index)
                        for total in totals:
                            value = splat(builder.load(builder.gep(inputs, [at])))
                            product = builder.fmul(value, weight, flags=("contract",))
                            builder.store(builder.fadd(builder.load(total), product, flags=("contract",)), total)
                            at = builder.add(at, x_step)
            zero = ir.Constant(vf, [0.0] * lanes)
            at = y_at
            for total in totals:
                value = builder.load(total)
                if rectify:  # this comparison keeps NaN
                    value = builder.select(builder.fcmp_ordered("<", value, zero), zero, value)
                builder.store(value, vector_at(outputs, at)).align = 4
                at = builder.add(at, y_step)
            return context.get_dummy_value()

        return signature, codegen

    return vector


def tile(positions: int, lanes: int, rectify: bool) -> Any:
    """A function for kernels: biases plus weights times inputs for `positions` x `lanes` outputs, then maybe ReLU.

    Its arguments: inputs x float32 [any], with the offset of the first position and the stride of positions, number and
    stride of planes, number and stride of rows, and length of a run; weights w, their offset, the units of the whole
    layer, and the offset of the biases; outputs y, their offset and the stride of positions. Each output is summed in
    the order of its inputs, on any machine.
    """
    return plain_tile(positions, lanes, rectify) if CONFIG.DISABLE_JIT else vector_tile(positions, lanes, rectify)


def plain_dense(lanes: int, chains: int) -> Callable[..., None]:
    """Units of a dense layer in plain Python; see `dense`."""

    def plain(x, x_at, n, w, w_at, width, bias_at, y, y_at):
        totals = np.zeros((chains, lanes), dtype=np.float32)
        totals[0] = w[bias_at : bias_at + lanes]
        for i in range(n):
            at = w_at + i * width
            totals[i % chains] += x[x_at + i] * w[at : at + lanes]
        y[y_at : y_at + lanes] = totals.sum(axis=0)

    return plain


def vector_dense(lanes: int, chains: int) -> Any:
    """Units of a dense layer as an intrinsic for kernels; see `dense`."""

    @intrinsic
    def vector(typingctx, x, x_at, n, w, w_at, width, bias_at, y, y_at):
        i = types.int64
        signature = types.void(x, i, i, w, i, i, i, y, i)

        def codegen(context, builder, sig, args):
            f32, i32, i64 = ir.FloatType(), ir.IntType(32), ir.IntType(64)
            vf = ir.VectorType(f32, lanes)
            undefined = ir.Constant(vf, ir.Undefined)
            inputs, weights, outputs = (
                context.make_array(sig.args[k])(context, builder, args[k]).data for k in (0, 3, 7)
            )
            x_at, n, w_at, width, bias_at, y_at = (args[k] for k in (1, 2, 4, 5, 6, 8))

            def vector_at(pointer: ir.Value, at: ir.Value) -> ir.Value:
                return builder.bitcast(builder.gep(pointer, [at]), vf.as_pointer())

            def load(at: ir.Value) -> ir.Value:
                value = builder.load(vector_at(weights, at))
                value.align = 4
                return value

            def add(total: ir.Value, k: ir.Value) -> None:
                value = builder.load(builder.gep(inputs, [builder.add(x_at, k)]))
                one = builder.insert_element(undefined, value, ir.Constant(i32, 0))
                splat = builder.shuffle_vector(one, undefined, ir.Constant(ir.VectorType(i32, lanes), [0] * lanes))
                product = builder.fmul(splat, load(builder.add(w_at, builder.mul(k, width))), flags=("contract",))
                builder.store(builder.fadd(builder.load(total), product, flags=("contract",)), total)

            totals = [cgutils.alloca_once(builder, vf) for _ in range(chains)]
            builder.store(load(bias_at), totals[0])
            for total in totals[1:]:
                builder.store(ir.Constant(vf, [0.0] * lanes), total)
            step = ir.Constant(i64, chains)
            whole = builder.mul(builder.sdiv(n, step), step)
            with cgutils.for_range_slice(builder, ir.Constant(i64, 0), whole, step, i64) as (k, _):
                for c, total in enumerate(totals):
                    add(total, builder.add(k, ir.Constant(i64, c)))
            with cgutils.for_range_slice(builder, whole, n, ir.Constant(i64, 1), i64) as (k, _):
                add(totals[0], k)
            result = builder.load(totals[0])
            for total in totals[1:]:
                result = builder.fadd(result, builder.load(total))
            builder.store(result, vector_at(outputs, y_at)).align = 4
            return context.get_dummy_value()

        return signature, codegen

    return vector


def dense(lanes: int, chains: int) -> Any:
    """A function for kernels: biases plus weights times inputs, for `lanes` units of a dense layer.

    Its arguments: inputs x float32 [any], their offset and number; weights w, their offset, the stride from one input
    to the next, and the offset of the biases; outputs y and their offset. Inputs are summed in `chains` independent
    parts, which hides the latency of additions where there are few lanes.
    """
    return plain_dense(lanes, chains) if CONFIG.DISABLE_JIT else vector_dense(lanes, chains)
