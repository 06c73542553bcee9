"""Marching 32 rays to the edge of the road, all in lockstep.

The code is emitted as LLVM vectors of 32, which LLVM maps to the machine's registers. A ray that has arrived is refined
further while others march.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
from llvmlite import ir
from numba.core import cgutils, types
from numba.core.extending import intrinsic

from gridsim.jit import F
from gridsim.maps.roads import CELLS_PER_UNIT, FIELD_FLOOR, FIELD_STEPS

SIMD_RAYS = 32
# Lengths in units (`SimConfig.unit`). Chosen for a small error (99th percentile over 4,000 poses: 0.06) and few steps
# of the slowest ray.
_NEAR = F(2.0)  # clearance below which Newton steps are taken
_STRETCH = F(1.5)  # a stretched step, taken above _NEAR, is this times the clearance
_CLOSE = F(0.04)  # a ray that is nearer than this to the edge, on either side, has arrived
_SLOPE_MIN = F(0.1)  # least slope of a Newton step, which is thus at most ten times the clearance
LEAP = F(2.0)  # most by which a Newton step exceeds a stretched one: any step is then below clearance + THICK_WALL
MARGIN = F(0.1)  # among thin walls, the leap is the thinnest wall's thickness less this, for safety


def vector_march(steps: int, look_back: bool) -> Any:
    """Build the intrinsic that moves each of SIMD_RAYS rays to the edge of the road, in at most `steps` steps.

    The intrinsic's arguments: `Road.field`, its columns and rows; origin, in the field's nodes; reach; the heading as
    cosine and sine; fan of `rays.fan` and the index of the first ray to march; the leap (as LEAP); ranges float32
    [rays], of which those of the SIMD_RAYS from that ray on are written, in [0, reach]. Lengths are in units
    (`SimConfig.unit`). It stops earlier once all these rays have arrived. With `look_back`, a ray goes back if the part
    of a step that it did not see is longer than the leap. Without, no code for that is emitted, and rays may pass walls
    thinner than THICK_WALL.
    """

    @intrinsic
    def march(typingctx, field, columns, rows, px0, py0, reach, cosine, sine, fan, ray, leap, ranges):
        f, u, n = types.float32, types.uint32, types.int64
        signature = types.void(field, u, u, f, f, f, f, f, fan, n, f, ranges)

        def codegen(context, builder, sig, args):
            f32, i32 = ir.FloatType(), ir.IntType(32)
            vf, vi = ir.VectorType(f32, SIMD_RAYS), ir.VectorType(i32, SIMD_RAYS)

            def splat(value: ir.Value, vector: ir.VectorType) -> ir.Value:
                single = builder.insert_element(ir.Constant(vector, ir.Undefined), value, ir.Constant(i32, 0))
                zeros = ir.Constant(ir.VectorType(i32, SIMD_RAYS), [0] * SIMD_RAYS)
                return builder.shuffle_vector(single, ir.Constant(vector, ir.Undefined), zeros)

            def const(value: float | np.floating) -> ir.Constant:
                return ir.Constant(vf, [float(value)] * SIMD_RAYS)

            flags = ("contract", "nsz", "arcp")
            add, sub, mul = (partial(op, flags=flags) for op in (builder.fadd, builder.fsub, builder.fmul))

            def least(a, b):
                return builder.select(builder.fcmp_ordered("<", a, b), a, b)

            def most(a, b):
                return builder.select(builder.fcmp_ordered(">", a, b), a, b)

            def array(k: int) -> Any:
                return context.make_array(sig.args[k])(context, builder, args[k])

            def gather(values: ir.Value, index: ir.Value, vector: ir.VectorType) -> ir.Value:
                found: ir.Value = ir.Constant(vector, ir.Undefined)
                for lane in (ir.Constant(i32, k) for k in range(SIMD_RAYS)):
                    at = builder.zext(builder.extract_element(index, lane), ir.IntType(64))
                    found = builder.insert_element(found, builder.load(builder.gep(values, [at])), lane)
                return found

            field_data = array(0).data
            columns, rows = args[1], args[2]
            one = ir.Constant(i32, 1)
            mask_x, mask_y = splat(builder.sub(columns, one), vi), splat(builder.sub(rows, one), vi)
            columns_v = splat(columns, vi)
            x0, y0, limit = splat(args[3], vf), splat(args[4], vf), splat(args[5], vf)
            floor_of = cgutils.get_or_insert_function(
                builder.module, ir.FunctionType(vf, [vf]), f"llvm.floor.v{SIMD_RAYS}f32"
            )

            fan, ray, leap = array(8), args[9], splat(args[10], vf)
            lanes_in_fan = cgutils.unpack_tuple(builder, fan.shape)[1]

            def of_fan(k: int) -> ir.Value:
                at = builder.add(builder.mul(lanes_in_fan, ir.Constant(lanes_in_fan.type, k)), ray)
                return builder.load(builder.bitcast(builder.gep(fan.data, [at]), vf.as_pointer()), align=4)

            cosine, sine = splat(args[6], vf), splat(args[7], vf)
            dx = sub(mul(cosine, of_fan(0)), mul(sine, of_fan(1)))
            dy = add(mul(sine, of_fan(0)), mul(cosine, of_fan(1)))
            sx, sy = mul(dx, const(CELLS_PER_UNIT)), mul(dy, const(CELLS_PER_UNIT))

            def look(t: ir.Value | None) -> tuple[ir.Value, ir.Value]:
                """Clearances and next steps (units) at ranges `t`, or at the origin, where rays read the same word."""
                px, py = (x0, y0) if t is None else (add(x0, mul(t, sx)), add(y0, mul(t, sy)))
                fx, fy = builder.call(floor_of, [px]), builder.call(floor_of, [py])
                ux, uy = sub(px, fx), sub(py, fy)
                column = builder.and_(builder.fptosi(fx, vi), mask_x)
                row = builder.and_(builder.fptosi(fy, vi), mask_y)
                index = builder.add(builder.mul(row, columns_v), column)
                if t is None:
                    at = builder.zext(builder.extract_element(index, ir.Constant(i32, 0)), ir.IntType(64))
                    word = splat(builder.load(builder.gep(field_data, [at])), vi)
                else:
                    word = gather(field_data, index, vi)

                def byte(shift: int) -> ir.Value:
                    part = builder.lshr(word, ir.Constant(vi, [shift] * SIMD_RAYS))
                    return builder.sitofp(builder.and_(part, ir.Constant(vi, [255] * SIMD_RAYS)), vf)

                q00, q10, q01, q11 = byte(0), byte(8), byte(16), byte(24)
                rise_low, rise_high = sub(q10, q00), sub(q11, q01)
                low, high = add(q00, mul(ux, rise_low)), add(q01, mul(ux, rise_high))
                across = sub(high, low)
                clear = add(mul(add(low, mul(uy, across)), const(1.0 / FIELD_STEPS)), const(FIELD_FLOOR))
                along = add(mul(dx, add(rise_low, mul(uy, sub(rise_high, rise_low)))), mul(dy, across))
                slope = mul(along, const(-CELLS_PER_UNIT / FIELD_STEPS))
                slope = least(most(slope, const(_SLOPE_MIN)), const(1.0))
                wide = builder.fcmp_ordered(">", clear, const(_NEAR))
                stretched = mul(clear, const(_STRETCH))
                newton = builder.fdiv(clear, slope, flags=flags)
                bound = most(add(stretched, leap), leap)
                step = builder.select(wide, stretched, least(newton, bound))
                return clear, step

            here, first = look(None)
            first, free_at_first = least(most(first, const(0.0)), limit), most(here, const(0.0))
            before = builder.block
            loop, done = builder.append_basic_block("march"), builder.append_basic_block("marched")
            builder.branch(loop)
            builder.position_at_end(loop)
            k = builder.phi(i32)
            t, safe = builder.phi(vf), builder.phi(vf)
            k.add_incoming(ir.Constant(i32, 0), before)
            t.add_incoming(first, before)
            safe.add_incoming(free_at_first, before)
            clear, step = look(t)
            running = builder.fcmp_ordered("<", t, limit)
            t_next = add(t, builder.select(running, step, const(0.0)))
            size = builder.select(builder.fcmp_ordered("<", clear, const(0.0)), builder.fsub(const(0.0), clear), clear)
            active = builder.and_(running, builder.fcmp_ordered(">=", size, const(_CLOSE)))
            safe_next = safe
            if look_back:
                seen = add(safe, leap)
                blind = builder.fcmp_ordered(">", sub(t, size), seen)
                further = add(t, clear)
                free = builder.fcmp_ordered(">", clear, const(0.0))
                known = builder.and_(free, builder.fcmp_ordered(">", further, safe))
                safe_next = builder.select(builder.and_(known, builder.not_(blind)), further, safe)
                t_next = builder.select(blind, seen, most(t_next, safe_next))
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
            if look_back:
                t_next = least(t_next, add(safe_next, leap))
            found = cgutils.alloca_once(builder, vf)
            builder.store(least(most(t_next, const(0.0)), limit), found)
            ranges = array(11)
            left = builder.sub(cgutils.unpack_tuple(builder, ranges.shape)[0], ray)
            lanes = ir.Constant(left.type, SIMD_RAYS)
            count = builder.select(builder.icmp_signed("<", left, lanes), left, lanes)
            single = builder.bitcast(found, f32.as_pointer())
            with cgutils.for_range(builder, count, intp=left.type) as here:
                value = builder.load(builder.gep(single, [here.index]))
                builder.store(value, builder.gep(ranges.data, [builder.add(ray, here.index)]))
            return context.get_dummy_value()

        return signature, codegen

    return march
