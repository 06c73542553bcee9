"""Vector code for `rays.march`: 32 rays in lockstep, emitted as LLVM vectors.

The arithmetic is that of the plain kernel `rays.march`; tests compare the two. Unlike there, a ray that has arrived is
refined further while others march. LLVM maps the vectors of 32 to the machine's registers.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba.core import cgutils, types
from numba.core.extending import intrinsic

SIMD_RAYS = 32


def march_intrinsic(
    steps: int,
    scale: float,
    unit: float,
    floor: float,
    slope_unit: float,
    near: float,
    stretch: float,
    close: float,
    slope_min: float,
    leap: float,
    gap: float | None,
) -> Any:
    """Build the intrinsic `march(field, columns, rows, px0, py0, reach, beams)`; numbers as in `rays`.

    With a gap of None, steps are not checked for blind parts, and no code for that is emitted.

    beams float32 [3, SIMD_RAYS], C-contiguous: direction x, direction y, and the range, which is read and written.
    """

    @intrinsic
    def march(typingctx, field, columns, rows, px0, py0, reach, beams):
        signature = types.void(field, types.uint32, types.uint32, types.float32, types.float32, types.float32, beams)

        def codegen(context, builder, sig, args):
            f32, i32 = ir.FloatType(), ir.IntType(32)
            vf, vi = ir.VectorType(f32, SIMD_RAYS), ir.VectorType(i32, SIMD_RAYS)

            def splat(value: ir.Value, vector: ir.VectorType) -> ir.Value:
                single = builder.insert_element(ir.Constant(vector, ir.Undefined), value, ir.Constant(i32, 0))
                zeros = ir.Constant(ir.VectorType(i32, SIMD_RAYS), [0] * SIMD_RAYS)
                return builder.shuffle_vector(single, ir.Constant(vector, ir.Undefined), zeros)

            def const(value: float) -> ir.Constant:
                return ir.Constant(vf, [value] * SIMD_RAYS)

            def iconst(value: int) -> ir.Constant:
                return ir.Constant(vi, [value] * SIMD_RAYS)

            flags = ("contract", "nsz", "arcp")

            def add(a, b):
                return builder.fadd(a, b, flags=flags)

            def sub(a, b):
                return builder.fsub(a, b, flags=flags)

            def mul(a, b):
                return builder.fmul(a, b, flags=flags)

            field_data = context.make_array(sig.args[0])(context, builder, args[0]).data
            beams_data = context.make_array(sig.args[6])(context, builder, args[6]).data
            columns, rows = args[1], args[2]
            one = ir.Constant(i32, 1)
            mask_x, mask_y = splat(builder.sub(columns, one), vi), splat(builder.sub(rows, one), vi)
            columns_v = splat(columns, vi)
            x0, y0, limit = splat(args[3], vf), splat(args[4], vf), splat(args[5], vf)
            floor_of = cgutils.get_or_insert_function(
                builder.module, ir.FunctionType(vf, [vf]), f"llvm.floor.v{SIMD_RAYS}f32"
            )

            def beam(k: int) -> ir.Value:
                at = builder.gep(beams_data, [ir.Constant(i32, k * SIMD_RAYS)])
                return builder.bitcast(at, vf.as_pointer())

            dx, dy = (builder.load(beam(k), align=4) for k in (0, 1))
            sx, sy = mul(dx, const(scale)), mul(dy, const(scale))
            first = builder.load(beam(2), align=4)

            before = builder.block
            loop, done = builder.append_basic_block("march"), builder.append_basic_block("marched")
            builder.branch(loop)
            builder.position_at_end(loop)
            k = builder.phi(i32)
            t, safe = builder.phi(vf), builder.phi(vf)
            k.add_incoming(ir.Constant(i32, 0), before)
            t.add_incoming(first, before)
            safe.add_incoming(first, before)
            px, py = add(x0, mul(t, sx)), add(y0, mul(t, sy))
            fx, fy = builder.call(floor_of, [px]), builder.call(floor_of, [py])
            ux, uy = sub(px, fx), sub(py, fy)
            column = builder.and_(builder.fptosi(fx, vi), mask_x)
            row = builder.and_(builder.fptosi(fy, vi), mask_y)
            index = builder.add(builder.mul(row, columns_v), column)
            word: ir.Value = ir.Constant(vi, ir.Undefined)
            for lane in range(SIMD_RAYS):
                at = builder.extract_element(index, ir.Constant(i32, lane))
                value = builder.load(builder.gep(field_data, [builder.zext(at, ir.IntType(64))]))
                word = builder.insert_element(word, value, ir.Constant(i32, lane))

            def byte(shift: int) -> ir.Value:
                part = builder.lshr(word, iconst(shift)) if shift else word
                return builder.sitofp(builder.and_(part, iconst(255)) if shift < 24 else part, vf)

            q00, q10, q01, q11 = byte(0), byte(8), byte(16), byte(24)
            rise_low, rise_high = sub(q10, q00), sub(q11, q01)
            low, high = add(q00, mul(ux, rise_low)), add(q01, mul(ux, rise_high))
            across = sub(high, low)
            clear = add(mul(add(low, mul(uy, across)), const(unit)), const(floor))
            along = add(mul(dx, add(rise_low, mul(uy, sub(rise_high, rise_low)))), mul(dy, across))
            slope = mul(along, const(-slope_unit))
            slope = builder.select(builder.fcmp_ordered(">", slope, const(slope_min)), slope, const(slope_min))
            slope = builder.select(builder.fcmp_ordered("<", slope, const(1.0)), slope, const(1.0))
            wide = builder.fcmp_ordered(">", clear, const(near))
            stretched = mul(clear, const(stretch))
            newton = builder.fdiv(clear, slope, flags=flags)
            bound = add(stretched, const(leap))
            bound = builder.select(builder.fcmp_ordered(">", bound, const(leap)), bound, const(leap))
            newton = builder.select(builder.fcmp_ordered("<", newton, bound), newton, bound)
            step = builder.select(wide, stretched, newton)
            running = builder.fcmp_ordered("<", t, limit)
            t_next = add(t, builder.select(running, step, const(0.0)))
            size = builder.select(builder.fcmp_ordered("<", clear, const(0.0)), builder.fsub(const(0.0), clear), clear)
            active = builder.and_(running, builder.fcmp_ordered(">=", size, const(close)))
            safe_next = safe
            if gap is not None:
                seen = add(safe, const(gap))
                blind = builder.fcmp_ordered(">", sub(t, size), seen)
                further = add(t, clear)
                free = builder.fcmp_ordered(">", clear, const(0.0))
                known = builder.and_(free, builder.fcmp_ordered(">", further, safe))
                safe_next = builder.select(builder.and_(known, builder.not_(blind)), further, safe)
                t_next = builder.select(builder.fcmp_ordered(">", t_next, safe_next), t_next, safe_next)
                t_next = builder.select(blind, seen, t_next)
                active = builder.or_(active, blind)
            bits = ir.IntType(SIMD_RAYS)
            any_active = builder.icmp_unsigned("!=", builder.bitcast(active, bits), ir.Constant(bits, 0))
            k_next = builder.add(k, one)
            more = builder.and_(any_active, builder.icmp_unsigned("<", k_next, ir.Constant(i32, steps)))
            k.add_incoming(k_next, builder.block)
            t.add_incoming(t_next, builder.block)
            safe.add_incoming(safe_next, builder.block)
            builder.cbranch(more, loop, done)
            builder.position_at_end(done)
            if gap is not None:
                seen = add(safe_next, const(gap))
                t_next = builder.select(builder.fcmp_ordered("<", t_next, seen), t_next, seen)
            t_last = builder.select(builder.fcmp_ordered(">", t_next, const(0.0)), t_next, const(0.0))
            t_last = builder.select(builder.fcmp_ordered("<", t_last, limit), t_last, limit)
            builder.store(t_last, beam(2), align=4)
            return context.get_dummy_value()

        return signature, codegen

    return march
