"""Vectors of :mod:`toolkit.geometry.simd` from and to arrays. Nothing is checked: an index too far is a crash."""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils

from toolkit.geometry.simd import F8, FLOATS, INT, INTS, LANES, operation


def _is_plain(kind: Any, ndim: int) -> bool:
    fits = isinstance(kind, types.Array) and kind.layout == "C" and kind.ndim == ndim
    return fits and kind.dtype in (types.float32, types.int32)


def _vector_address(context: Any, builder: ir.IRBuilder, kind: Any, array: Any, index: Any) -> ir.Value:
    """Return the address of the vector that starts at array[index]."""
    data = context.make_array(kind)(context, builder, array).data
    vectors = FLOATS if kind.dtype == types.float32 else INTS
    return builder.bitcast(builder.gep(data, [index]), vectors.as_pointer())


@operation
def load(typingctx: Any, array: Any, index: Any) -> Any:
    """load(array, i): F8 of array[i : i + 8]; a contiguous float32 vector, any alignment, not checked."""
    if not _is_plain(array, 1) or array.dtype != types.float32 or not isinstance(index, types.Integer):
        return None

    def generate(context: Any, builder: ir.IRBuilder, signature: Any, args: Any) -> ir.Value:
        return builder.load(_vector_address(context, builder, signature.args[0], args[0], args[1]), align=4)

    return F8(array, index), generate


@operation
def store(typingctx: Any, array: Any, index: Any, value: Any) -> Any:
    """store(array, i, v): array[i : i + 8] = v, rounded towards zero in an int32 array; see :func:`load`."""
    if not _is_plain(array, 1) or not isinstance(index, types.Integer) or value != F8:
        return None

    def generate(context: Any, builder: ir.IRBuilder, signature: Any, args: Any) -> ir.Value:
        whole = signature.args[0].dtype == types.int32
        item = builder.fptosi(args[2], INTS) if whole else args[2]
        builder.store(item, _vector_address(context, builder, signature.args[0], args[0], args[1]), align=4)
        return context.get_dummy_value()

    return types.void(array, index, value), generate


@operation
def prefetch(typingctx: Any, array: Any, row: Any) -> Any:
    """prefetch(array, i): have the start of array[i] brought near; a contiguous matrix, any i."""
    if not _is_plain(array, 2) or not isinstance(row, types.Integer):
        return None

    def generate(context: Any, builder: ir.IRBuilder, signature: Any, args: Any) -> ir.Value:
        view = context.make_array(signature.args[0])(context, builder, args[0])
        wide = context.cast(builder, args[1], signature.args[1], types.int64)
        data = builder.gep(view.data, [builder.mul(wide, builder.extract_value(view.shape, 1))])
        address = builder.bitcast(data, ir.IntType(8).as_pointer())
        kind = ir.FunctionType(ir.VoidType(), [address.type, INT, INT, INT])
        function = cgutils.get_or_insert_function(builder.module, kind, "llvm.prefetch.p0i8")
        # For reading, to be kept in all caches, data.
        builder.call(function, [address, *(ir.Constant(INT, value) for value in (0, 3, 1))])
        return context.get_dummy_value()

    return types.void(array, row), generate


@operation
def store_row(typingctx: Any, array: Any, row: Any, value: Any) -> Any:
    """store_row(array, i, v): array[i, :8] = v; a contiguous float32 matrix, not checked."""
    if not _is_plain(array, 2) or not isinstance(row, types.Integer) or value != F8:
        return None

    def generate(context: Any, builder: ir.IRBuilder, signature: Any, args: Any) -> ir.Value:
        view = context.make_array(signature.args[0])(context, builder, args[0])
        index = builder.mul(args[1], builder.extract_value(view.shape, 1))
        address = builder.bitcast(builder.gep(view.data, [index]), FLOATS.as_pointer())
        builder.store(args[2], address, align=4)
        return context.get_dummy_value()

    return types.void(array, row, value), generate


def _lane_addresses(
    context: Any, builder: ir.IRBuilder, kinds: Any, array: Any, row: Any, column: Any, last: Any
) -> list[ir.Value]:
    """Return the addresses of array[min(row + lane, last), column]."""
    view = context.make_array(kinds[0])(context, builder, array)
    wide = types.int64
    row, column, last = (
        context.cast(builder, value, kind, wide)
        for value, kind in zip((row, column, last), kinds[1:4], strict=True)
    )
    width = builder.extract_value(view.shape, 1)
    addresses = []
    for lane in range(LANES):
        index = builder.add(row, ir.Constant(row.type, lane))
        index = builder.select(builder.icmp_signed("<", index, last), index, last)
        addresses.append(builder.gep(view.data, [builder.add(builder.mul(index, width), column)]))
    return addresses


@operation
def gather(typingctx: Any, array: Any, row: Any, column: Any, last: Any) -> Any:
    """gather(array, i, k, last): F8 of column k of rows i to i + 7, the last row again beyond it; not checked."""
    if not _is_plain(array, 2):
        return None

    def generate(context: Any, builder: ir.IRBuilder, signature: Any, args: Any) -> ir.Value:
        whole = signature.args[0].dtype == types.int32
        vector = ir.Constant(INTS if whole else FLOATS, ir.Undefined)
        for lane, address in enumerate(_lane_addresses(context, builder, signature.args, *args)):
            vector = builder.insert_element(vector, builder.load(address), ir.Constant(INT, lane))
        return builder.sitofp(vector, FLOATS) if whole else vector

    return F8(array, row, column, last), generate


@operation
def scatter(typingctx: Any, array: Any, row: Any, column: Any, last: Any, value: Any) -> Any:
    """scatter(array, i, k, last, v): the reverse of :func:`gather`, rounded towards zero in an int32 array.

    Lanes beyond the last row are written to it too: they must hold what the last row's lane holds, as they do when
    they were computed from what ``gather`` gave.
    """
    if not _is_plain(array, 2) or value != F8:
        return None

    def generate(context: Any, builder: ir.IRBuilder, signature: Any, args: Any) -> ir.Value:
        whole = signature.args[0].dtype == types.int32
        items = builder.fptosi(args[4], INTS) if whole else args[4]
        for lane, address in enumerate(_lane_addresses(context, builder, signature.args, *args[:4])):
            builder.store(builder.extract_element(items, ir.Constant(INT, lane)), address)
        return context.get_dummy_value()

    return types.void(array, row, column, last, value), generate


@operation
def bilinear(typingctx: Any, image: Any, start: Any, width: Any, x: Any, y: Any) -> Any:
    """bilinear(image, start, width, x, y): F8 of an image's values between pixels, at columns x and rows y from 0.

    The image lies row by row from ``image[start]`` in a contiguous float32 vector; x must be below width - 1 and y
    below the last row. Nothing is checked.
    """
    if not _is_plain(image, 1) or image.dtype != types.float32 or (x, y) != (F8, F8):
        return None

    def generate(context: Any, builder: ir.IRBuilder, signature: Any, args: Any) -> ir.Value:
        kinds = signature.args
        data = context.make_array(kinds[0])(context, builder, args[0]).data
        first, wide = (context.cast(builder, args[i], kinds[i], types.int64) for i in (1, 2))
        column, row = builder.fptosi(args[3], INTS), builder.fptosi(args[4], INTS)
        right = builder.fsub(args[3], builder.sitofp(column, FLOATS))
        below = builder.fsub(args[4], builder.sitofp(row, FLOATS))
        places = []
        for lane in range(LANES):
            at, line = (
                builder.zext(builder.extract_element(part, ir.Constant(INT, lane)), ir.IntType(64))
                for part in (column, row)
            )
            places.append(builder.add(first, builder.add(at, builder.mul(line, wide))))
        upper = _mixed(builder, *_pairs(builder, data, places), right)
        lower = _mixed(builder, *_pairs(builder, data, [builder.add(place, wide) for place in places]), right)
        return _mixed(builder, upper, lower, below)

    return F8(image, start, width, x, y), generate


def _mixed(builder: ir.IRBuilder, a: ir.Value, b: ir.Value, share: ir.Value) -> ir.Value:
    """Return a + share (b - a)."""
    return builder.fadd(a, builder.fmul(share, builder.fsub(b, a)))


def _pairs(builder: ir.IRBuilder, data: ir.Value, places: list[ir.Value]) -> tuple[ir.Value, ir.Value]:
    """Return the values at eight places, and those after them: each two are one load."""
    double, half = ir.IntType(64), LANES // 2
    halves = []
    for begin in (0, half):
        vector = ir.Constant(ir.VectorType(double, half), ir.Undefined)
        for lane in range(half):
            address = builder.bitcast(builder.gep(data, [places[begin + lane]]), double.as_pointer())
            vector = builder.insert_element(vector, builder.load(address, align=4), ir.Constant(INT, lane))
        halves.append(builder.bitcast(vector, FLOATS))
    order = [[2 * lane + odd for lane in range(LANES)] for odd in (0, 1)]
    return (
        builder.shuffle_vector(halves[0], halves[1], ir.Constant(INTS, order[0])),
        builder.shuffle_vector(halves[0], halves[1], ir.Constant(INTS, order[1])),
    )
