"""Vector code for network layers, with sums held in registers.

`tile` makes a function that computes some units of a layer at some positions of the image; a dense layer has one
position. The inputs of a position are `planes` x `rows` runs of `run` consecutive numbers; those of a dense layer are a
single run. The function is emitted as LLVM vector code.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba.core import cgutils, types
from numba.core.extending import intrinsic


def tile(positions: int, lanes: int, rectify: bool, chains: int = 1) -> Any:
    """Make a function for kernels: biases plus weights times inputs, of `lanes` units (one vector) at `positions`.

    If `rectify`, the function applies ReLU. Its arguments are float32 arrays of any length, offsets in them and
    strides: inputs `x`, from `x_at` on, with stride `x_step` of positions; number and stride of planes, number and
    stride of rows, and `run`, the number of inputs in a row; weights `w`, from `w_at` on, with `width` units in the
    whole layer; biases, also in `w`, from `bias_at` on; outputs `y`, from `y_at` on, with stride `y_step` of positions.
    The inputs of a row take turns among `chains` sums, which are added at the very end (a remainder goes to the first),
    so that additions need not wait for each other where there are few units and positions. Their order is the same on
    any machine.
    """

    @intrinsic
    def vector(
        typingctx, x, x_at, x_step, planes, plane_step, rows, row_step, run, w, w_at, width, bias_at, y, y_at, y_step
    ):  # fmt: skip
        n = types.int64
        signature = types.void(x, n, n, n, n, n, n, n, w, n, n, n, y, n, n)

        def codegen(context, builder, sig, args):
            f32, i32, i64 = ir.FloatType(), ir.IntType(32), ir.IntType(64)
            vf = ir.VectorType(f32, lanes)
            undefined, zeros = ir.Constant(vf, ir.Undefined), ir.Constant(vf, [0.0] * lanes)

            def data(k: int) -> ir.Value:
                return context.make_array(sig.args[k])(context, builder, args[k]).data

            def vector_at(pointer: ir.Value, at: ir.Value) -> ir.Value:
                return builder.bitcast(builder.gep(pointer, [at]), vf.as_pointer())

            def load(at: ir.Value) -> ir.Value:
                value = builder.load(vector_at(weights, at))
                value.align = 4  # a genome is aligned to one float only
                return value

            def splat(value: ir.Value) -> ir.Value:
                single = builder.insert_element(undefined, value, ir.Constant(i32, 0))
                return builder.shuffle_vector(single, undefined, ir.Constant(ir.VectorType(i32, lanes), [0] * lanes))

            def add_input(i: ir.Value, totals: list[ir.Value]) -> None:
                weight = load(builder.add(row_w, builder.mul(i, width)))
                at = builder.add(row_at, i)
                for total in totals:
                    value = splat(builder.load(builder.gep(inputs, [at])))
                    product = builder.fmul(value, weight, flags=("contract",))
                    builder.store(builder.fadd(builder.load(total), product, flags=("contract",)), total)
                    at = builder.add(at, x_step)

            inputs, weights, outputs = data(0), data(8), data(12)
            x_at, x_step, planes, plane_step, rows, row_step, run = args[1:8]
            w_at, width, bias_at = args[9:12]
            y_at, y_step = args[13:15]
            sums = [[cgutils.alloca_once(builder, vf) for _ in range(positions)] for _ in range(chains)]
            bias = load(bias_at)
            for chain, totals in enumerate(sums):
                for total in totals:
                    builder.store(zeros if chain else bias, total)
            zero, one, step = (ir.Constant(i64, k) for k in (0, 1, chains))
            whole = builder.mul(builder.sdiv(run, step), step)
            row_width = builder.mul(run, width)
            with cgutils.for_range(builder, planes, intp=i64) as plane:
                plane_at = builder.add(x_at, builder.mul(plane.index, plane_step))
                plane_w = builder.add(w_at, builder.mul(builder.mul(plane.index, rows), row_width))
                with cgutils.for_range(builder, rows, intp=i64) as row:
                    row_at = builder.add(plane_at, builder.mul(row.index, row_step))
                    row_w = builder.add(plane_w, builder.mul(row.index, row_width))
                    with cgutils.for_range_slice(builder, zero, whole, step, i64) as (i, _):
                        for chain, totals in enumerate(sums):
                            add_input(builder.add(i, ir.Constant(i64, chain)), totals)
                    with cgutils.for_range_slice(builder, whole, run, one, i64) as (i, _):
                        add_input(i, sums[0])
            at = y_at
            for position in range(positions):
                value = builder.load(sums[0][position])
                for totals in sums[1:]:
                    value = builder.fadd(value, builder.load(totals[position]))
                if rectify:  # this comparison keeps NaN
                    value = builder.select(builder.fcmp_ordered("<", value, zeros), zeros, value)
                builder.store(value, vector_at(outputs, at)).align = 4
                at = builder.add(at, y_step)
            return context.get_dummy_value()

        return signature, codegen

    return vector
