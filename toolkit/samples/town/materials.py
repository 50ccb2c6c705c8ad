"""The materials of buildings, trees and small things: each a function from a :class:`Patch` to a :class:`Look`."""

from __future__ import annotations

import numpy as np

from toolkit.samples.town.meshes import ACCENTS
from toolkit.samples.town.noise import F32, Noise, inside, linear, mix, pulse
from toolkit.samples.town.surface import Look, Patch

_FRAME, _SILL, _MORTAR = linear("e9e6de"), linear("b5aea2"), linear("b8afa2")
_MOSS, _PANEL, _STEEL = linear("6c7148"), linear("1d2740"), linear("9aa0a4")
_ACCENTS = np.stack(ACCENTS)
_SILL_HEIGHT = 0.95  # metres from the floor of a storey to its windows


def facade(noise: Noise, patch: Patch) -> Look:
    """Plaster or brick with windows, sills, shutters and a door; the style is that of ``meshes.facade_style``."""
    u, v, size, style = patch.u, patch.v, patch.footprint, patch.style
    albedo = _wall(noise, patch)
    bay, storey, wide, high = style[:, 0], style[:, 1], style[:, 2], style[:, 3]
    floor, column = np.floor(v / storey), np.floor(u / bay)
    du = u - (column + 0.5) * bay
    dv = v - floor * storey - _SILL_HEIGHT - 0.5 * high
    low_wall = inside(style[:, 6] - 0.3 - v, size)
    door_bay = (column == style[:, 5]) & (floor == 0)

    def opening(grow: float) -> F32:
        return inside(0.5 * wide + grow - np.abs(du), size) * inside(0.5 * high + grow - np.abs(dv), size)

    wanted = low_wall * (~door_bay & (wide > 0.3))
    shutters = (style[:, 4] >= 2) * inside(0.25 * wide - np.abs(np.abs(du) - 0.78 * wide), size)
    shutters = shutters * inside(0.5 * high + 0.05 - np.abs(dv), size) * wanted
    slats = 1.0 - 0.3 * pulse(v, 0.12, 0.04, size)
    accent = _ACCENTS[style[:, 7].astype(np.int64)]
    albedo = mix(albedo, accent * slats[:, None], shutters)
    sill = inside(0.5 * wide + 0.12 - np.abs(du), size) * inside(0.07 - np.abs(dv + 0.5 * high + 0.12), size)
    albedo = mix(albedo, _SILL, sill * wanted)
    albedo = mix(albedo, _FRAME, opening(0.09) * wanted)
    pane = opening(0.0) * (1 - inside(0.03 - np.abs(du), size)) * (1 - inside(0.025 - np.abs(dv - 0.2), size))
    pane = pane * wanted
    albedo = mix(albedo, _interior(noise, patch, column, floor, du / wide, dv / high), pane)
    door = inside(0.55 - np.abs(du), size) * inside(2.15 - v, size) * door_bay
    albedo = mix(albedo, _FRAME, inside(0.67 - np.abs(du), size) * inside(2.27 - v, size) * door_bay)
    boards = 1.0 - 0.25 * pulse(du, 0.22, 0.03, size)
    albedo = mix(albedo, accent * boards[:, None], door)
    return Look(albedo, mirror=0.16 * pane)


def _wall(noise: Noise, patch: Patch) -> F32:
    """Return the albedo (N, 3) of the bare wall."""
    u, v, size = patch.u, patch.v, patch.footprint
    shift = (patch.face % 251).astype(np.float32) * np.float32(3.7)
    detail = noise.fbm(u + shift, v, size, coarsest=2.0, finest=0.01, gain=0.9)
    streaks = noise.fbm(u * 3 + shift, v * np.float32(0.35), size, coarsest=1.5, finest=0.2)
    bricks = (patch.style[:, 4] % 2) > 0
    course = np.floor(v / 0.11)
    shifted = u + np.where(course % 2 == 0, 0.0, 0.14).astype(np.float32)
    fade = np.clip(0.16 / size - 0.4, 0.0, 1.0)
    each = 1 + fade * 0.75 * (noise.cell(np.floor(shifted / 0.28), course, patch.face) - 0.5)
    mortar = 1 - (1 - pulse(shifted, 0.28, 0.02, size)) * (1 - pulse(v, 0.11, 0.02, size))
    tone = np.clip(1 + np.where(bricks, 0.13, 0.11) * detail + 0.07 * streaks, 0.3, 1.8) * np.where(
        bricks, each, 1.0
    )
    albedo = patch.colour * tone[:, None].astype(np.float32)
    albedo = mix(albedo, _MORTAR, (mortar * 0.8 * bricks).astype(np.float32))
    foot = inside(0.45 + 0.08 * detail - v, size)
    return mix(albedo, albedo * 0.62, foot)


def _interior(noise: Noise, patch: Patch, column: F32, floor: F32, across: F32, up: F32) -> F32:
    """Return what is seen (N, 3) through window panes: dark rooms, curtains, blinds; different in each window."""
    draw = noise.cell(column, floor, patch.face)
    second = noise.cell(column, floor, patch.face + 7919)
    colour = (0.015 + 0.06 * second)[:, None] * np.array([1.0, 1.05, 1.15], np.float32)
    cloth = (0.35 + 0.3 * second)[:, None] * np.array([1.0, 0.95, 0.85], np.float32)
    curtains = (draw > 0.45) & (np.abs(across) > 0.2 + 0.2 * second)
    blind = (draw < 0.3) & (up > 0.45 - 0.9 * second)
    covered = (curtains | blind).astype(np.float32)
    return mix(colour.astype(np.float32), cloth.astype(np.float32), 0.8 * covered)


def glass(noise: Noise, patch: Patch) -> Look:
    """A curtain wall of mullions, spandrels and reflecting panes; plain where the bay is as wide as the face."""
    u, v, size, style = patch.u, patch.v, patch.footprint, patch.style
    plain = style[:, 4] == 4.0
    bay, storey = style[:, 0], style[:, 1]
    detail = noise.fbm(u + patch.face % 97, v, size, coarsest=1.5, finest=0.01)
    column, floor = np.floor(u / bay), np.floor(v / storey)
    rise = v - floor * storey
    bars = np.maximum(pulse(u + 0.04, bay, 0.08, size), pulse(v + 0.05, storey, 0.1, size))
    panel = np.maximum(inside(0.75 - rise, size), inside(v - style[:, 6], size))
    tint = 0.75 + 0.5 * noise.cell(column, floor, patch.face)
    dark = np.array([0.03, 0.045, 0.055], np.float32) * tint[:, None]
    slab = patch.colour * (0.55 * tint * (1 + 0.14 * detail))[:, None]
    albedo = mix(mix(dark, slab, panel), _STEEL * np.clip(1 + 0.1 * detail, 0.5, 1.5)[:, None], bars)
    pane = (1 - panel) * (1 - bars)
    albedo = np.where(plain[:, None], patch.colour, albedo)
    pane = np.where(plain, 0.35, pane)
    # Panes are never mounted quite alike: each reflects a slightly different part of the sky.
    tilt = np.stack([noise.cell(column, floor, patch.face + salt) - 0.5 for salt in (1, 2, 3)], axis=1)
    return Look(
        albedo.astype(np.float32), mirror=(0.55 * pane).astype(np.float32), roughness=np.float32(0.02) * tilt
    )


def tiles(noise: Noise, patch: Patch) -> Look:
    """Roof tiles in courses, with moss, roof windows and on some roofs solar panels.

    Style: length along the eaves, length of the slope (metres), 1 for solar panels, seed.
    """
    u, v, size, style = patch.u, patch.v, patch.footprint, patch.style
    detail = noise.fbm(u + style[:, 3], v, size, coarsest=2.5, finest=0.012, gain=0.9)
    course = np.floor(v / 0.34)
    shifted = u + np.where(course % 2 == 0, 0.0, 0.14).astype(np.float32)
    fade = np.clip(0.3 / size - 0.4, 0.0, 1.0)
    each = 1 + fade * 0.7 * (noise.cell(np.floor(shifted / 0.28), course, patch.face) - 0.5)
    shadow = (1 - 0.45 * pulse(v, 0.34, 0.06, size)) * (1 - 0.3 * pulse(shifted, 0.28, 0.03, size))
    tone = np.clip(1 + 0.16 * detail, 0.3, 1.9) * each * shadow
    albedo = patch.colour * tone[:, None]
    moss = inside(noise.value(u / 1.3 + style[:, 3], v / 1.3) + 0.25 * detail - 0.62, size / 1.3)
    albedo = mix(albedo, _MOSS * np.clip(1 + 0.2 * detail, 0.4, 1.6)[:, None], 0.75 * moss)
    ridge = inside(v - (style[:, 1] - 0.22), size)
    albedo = mix(albedo, patch.colour * (0.7 + 0.3 * pulse(u, 0.4, 0.36, size))[:, None], ridge)
    column, row = np.floor(u / 3.0), np.floor(v / 2.6)
    du, dv = u - (column + 0.5) * 3.0, v - (row + 0.5) * 2.6
    room = (
        (u > 0.8)
        & (u < style[:, 0] - 0.8)
        & ((row + 1) * 2.6 < style[:, 1] - 0.4)
        & ((column + 1) * 3 < style[:, 0])
    )
    window = ((noise.cell(column, row, patch.face) < 0.2) & room & (style[:, 2] == 0)).astype(np.float32)
    frame = inside(0.48 - np.abs(du), size) * inside(0.68 - np.abs(dv), size) * window
    pane = inside(0.38 - np.abs(du), size) * inside(0.56 - np.abs(dv), size) * window
    albedo = mix(mix(albedo, _STEEL * 0.5, frame), _PANEL * 0.8, pane)
    field = inside(np.minimum(u - 1.2, style[:, 0] - 1.2 - u), size) * inside(
        np.minimum(v - 0.9, style[:, 1] - 0.9 - v), size
    )
    field = field * (style[:, 2] > 0)
    grid = np.maximum(pulse(u, 1.0, 0.05, size), pulse(v, 1.6, 0.05, size))
    lines = np.maximum(pulse(u, 0.166, 0.012, size), pulse(v, 0.16, 0.012, size))
    solar = mix(_PANEL * (1 + 1.5 * lines)[:, None], _STEEL, grid)
    albedo = mix(albedo, solar, field)
    return Look(albedo.astype(np.float32), mirror=(0.25 * pane + 0.12 * field * (1 - grid)).astype(np.float32))


def flat_roof(noise: Noise, patch: Patch) -> Look:
    """Gravel and roofing felt with seams and puddle stains."""
    u, v, size = patch.u, patch.v, patch.footprint
    shift = (patch.face % 113).astype(np.float32) * np.float32(2.3)
    detail = noise.fbm(u + shift, v, size, coarsest=3.0, finest=0.012, gain=0.95)
    seams = np.maximum(pulse(u, 1.5, 0.06, size), pulse(v, 4.0, 0.06, size))
    stain = inside(noise.value(u / 2.2 + shift, v / 2.2) + 0.2 * detail - 0.35, size / 2.2)
    sheet = 0.9 + 0.2 * noise.cell(np.floor(u / 1.5), np.floor(v / 4.0), patch.face)
    tone = np.clip(1 + 0.2 * detail, 0.3, 2.0) * (1 - 0.35 * seams) * (1 - 0.3 * stain) * sheet
    return Look(patch.colour * tone[:, None].astype(np.float32))


def leaves(noise: Noise, patch: Patch) -> Look:
    """Foliage: clumps of lit and shaded leaves, laid along the axis that the surface faces most."""
    point = patch.point.astype(np.float32)
    facing = np.abs(patch.normal).argmax(axis=1)
    a = np.where(facing == 0, point[:, 1], point[:, 0])
    b = np.where(facing == 2, point[:, 1], point[:, 2])
    detail = noise.fbm(a, b, patch.footprint, coarsest=1.1, finest=0.02, gain=0.95)
    other = noise.fbm(a + 31, b - 17, patch.footprint, coarsest=0.6, finest=0.05, gain=0.95)
    tone = np.clip(1.0 + 0.42 * detail, 0.18, 2.4)
    tint = np.stack([1 + 0.1 * other, 1 + 0.02 * other, 1 - 0.12 * other], axis=1)
    rough = np.stack([0.45 * detail, 0.45 * other, 0.3 * (detail - other)], axis=1)
    return Look(patch.colour * tone[:, None] * np.clip(tint, 0.5, 1.5), roughness=rough)


def bark(noise: Noise, patch: Patch) -> Look:
    """Bark with furrows along the trunk."""
    detail = noise.fbm(patch.u * 4 + patch.face % 53, patch.v, patch.footprint, coarsest=0.8, finest=0.02)
    return Look(patch.colour * np.clip(1 + 0.3 * detail, 0.3, 1.8)[:, None])


def paint(noise: Noise, patch: Patch) -> Look:
    """Painted metal and wood with some wear. Style: 1 for a louvred box, 2 for a car."""
    detail = noise.fbm(patch.u + patch.face % 71, patch.v, patch.footprint, coarsest=0.5, finest=0.015)
    louvres = 0.45 * pulse(patch.v, 0.12, 0.05, patch.footprint) * (patch.style[:, 0] == 1)
    tone = np.clip(1 + 0.09 * detail, 0.4, 1.6) * (1 - louvres)
    return Look(patch.colour * tone[:, None], mirror=np.where(patch.style[:, 0] == 2, 0.05, 0.0).astype(np.float32))


def stone(noise: Noise, patch: Patch) -> Look:
    """Cut stone in courses."""
    u, v, size = patch.u, patch.v, patch.footprint
    detail = noise.fbm(u + patch.face % 89, v, size, coarsest=0.8, finest=0.008, gain=0.95)
    fade = np.clip(0.4 / size - 0.4, 0.0, 1.0)
    block = 1 + fade * 0.3 * (noise.cell(np.floor(u / 0.6), np.floor(v / 0.3), patch.face) - 0.5)
    joints = np.maximum(pulse(u, 0.6, 0.02, size), pulse(v, 0.3, 0.02, size))
    tone = np.clip(1 + 0.17 * detail, 0.3, 1.9) * block * (1 - 0.4 * joints)
    return Look(patch.colour * tone[:, None].astype(np.float32))
