"""Inner loops over beams, compiled by numba.

numba keeps the compiled code beside this file, or in NUMBA_CACHE_DIR, so it is compiled once per machine.
"""

from __future__ import annotations

import math

import numba
import numpy as np

MIN_STEP_CELLS = 0.25  # shorter steps would take long along walls, longer ones would jump over corners
MAX_STEPS = 2000
SHORT_MISFIT_FACTOR = 0.6  # a beam that is too short counts less than one too long, because it may be blocked
UNKNOWN_MISFIT = 0.4  # of a beam for which the model expects nothing
FACING = 0.02  # lower limit of |n . u| in divisions
GRAZING = 0.05  # no derivative is computed if |n . u| is less (below three degrees of incidence, or at an edge)

jit = numba.njit(cache=True, nogil=True, error_model="numpy")


@jit
def lookup(phi, x, y):
    """Interpolates phi (m) bilinearly at grid coordinates (cells).

    Returns phi, its derivatives by x and y (m per cell), and whether the point is inside the grid.
    """
    ny, nx = phi.shape
    if not (0 <= x < nx - 1 and 0 <= y < ny - 1):
        return 0.0, 0.0, 0.0, False
    j, i = int(x), int(y)
    u, v = x - j, y - i
    a = phi[i, j]
    b, c = phi[i, j + 1] - a, phi[i + 1, j] - a
    d = phi[i + 1, j + 1] - a - b - c
    return a + b * u + (c + d * u) * v, b + d * v, c + d * u, True


@jit
def trace_one(phi, h, x, y, ux, uy):
    """Traces one beam by sphere tracing, in grid coordinates.

    Returns the length of the beam and the least distance at which it passed another surface, both in m; inf if none.
    """
    t, step, previous, falling, dip = 0.0, 0.0, 0.0, False, np.inf
    for _ in range(MAX_STEPS):
        value, _, _, inside = lookup(phi, x + t * ux, y + t * uy)
        if not inside:
            return np.inf, dip
        value /= h
        if value <= 0.0:
            if step == 0.0:
                return 0.0, dip
            t -= step * -value / (previous - value)  # regula falsi with the last point in free space
            value, gx, gy, _ = lookup(phi, x + t * ux, y + t * uy)
            slope = gx * ux + gy * uy
            if slope < -FACING * h:  # one Newton step onto the surface
                t -= min(max(value / slope, -1.0), 1.0)
            return max(t, 0.0) * h, dip
        if falling and value > previous:
            dip = min(dip, previous * h)
        falling, previous = value < previous, value
        step = max(0.98 * value, MIN_STEP_CELLS)
        t += step
    return np.inf, dip


@jit
def trace(phi, ox, oy, h, lasers, angles, ranges, jacobian, dip, edge, facing):
    """Traces beams at ``angles`` (B,) from lasers (N, 3), and fills the fields of `field.Traced`.

    These are ranges (N, B), jacobian (N, B, 3), and dip, edge and facing (N, B). The derivative of a range is
    dr = -(n . dp + r n . u' dyaw) / (n . u). Edge is the depth one cell behind the surface, relative to a plane.
    """
    for k in range(lasers.shape[0]):
        x, y = (lasers[k, 0] - ox) / h, (lasers[k, 1] - oy) / h
        for b in range(angles.shape[0]):
            ux, uy = math.cos(lasers[k, 2] + angles[b]), math.sin(lasers[k, 2] + angles[b])
            r, passed = trace_one(phi, h, x, y, ux, uy)
            ranges[k, b], dip[k, b] = r, passed
            jacobian[k, b, :] = 0.0
            edge[k, b], facing[k, b] = 0.0, 0.0
            if r == np.inf:
                continue
            hx, hy = x + r / h * ux, y + r / h * uy
            _, gx, gy, _ = lookup(phi, hx, hy)
            length = max(math.hypot(gx, gy), 1e-9)
            nx, ny = gx / length, gy / length
            cosine = -min(nx * ux + ny * uy, -FACING)
            if cosine > GRAZING:
                jacobian[k, b, 0], jacobian[k, b, 1] = nx / cosine, ny / cosine
                jacobian[k, b, 2] = r * (ny * ux - nx * uy) / cosine
            behind, _, _, _ = lookup(phi, hx + ux, hy + uy)
            edge[k, b], facing[k, b] = -behind / (h * cosine), cosine


@jit
def cast(segments, circles, lasers, angles, ranges, jacobian):
    """Casts exact rays from lasers (N, 3) against segments (S, 4) and circles (C, 3).

    Fills ranges (N, B) and jacobian (N, B, 3).
    """
    for k in range(lasers.shape[0]):
        px, py = lasers[k, 0], lasers[k, 1]
        for b in range(angles.shape[0]):
            ux, uy = math.cos(lasers[k, 2] + angles[b]), math.sin(lasers[k, 2] + angles[b])
            best, nx, ny = np.inf, 0.0, 0.0
            for s in range(segments.shape[0]):
                ax, ay = segments[s, 0] - px, segments[s, 1] - py
                ex, ey = segments[s, 2] - segments[s, 0], segments[s, 3] - segments[s, 1]
                det = ux * ey - uy * ex
                if det == 0.0:
                    continue
                r, along = (ax * ey - ay * ex) / det, (ax * uy - ay * ux) / det
                if 0.0 <= r < best and 0.0 <= along <= 1.0:
                    length = math.hypot(ex, ey)
                    best, nx, ny = r, -ey / length, ex / length
            for s in range(circles.shape[0]):
                cx, cy, radius = circles[s, 0] - px, circles[s, 1] - py, circles[s, 2]
                middle = cx * ux + cy * uy
                under = middle * middle - (cx * cx + cy * cy - radius * radius)
                if under < 0.0:
                    continue
                r = middle - math.sqrt(under)
                if 0.0 <= r < best:
                    best, nx, ny = r, (r * ux - cx) / radius, (r * uy - cy) / radius
            ranges[k, b] = best
            jacobian[k, b, :] = 0.0
            if best == np.inf:
                continue
            dot = nx * ux + ny * uy
            if dot > 0.0:
                nx, ny, dot = -nx, -ny, -dot
            cosine = -min(dot, -FACING)
            jacobian[k, b, 0], jacobian[k, b, 1] = nx / cosine, ny / cosine
            jacobian[k, b, 2] = best * (ny * ux - nx * uy) / cosine


@jit
def accumulate(
    measured, expected, jacobian, scale, sigma, relative, extra_sigma, short, random, range_max, unseen,
    total, gradient, matrices,
):  # fmt: skip
    """Sums -ln p(o | pose) and its derivatives over the beams; see `services.estimator.precise.likelihood`.

    Adds to total (N, 3), whose columns are the energy, the expected number of inliers and the number of used beams; to
    gradient (N, 3); and to matrices (N, 3, 3, 3), which are the curvature and the covariances of the gradient caused by
    the scanner's noise and by the model's error.
    """
    flat = random / range_max
    for k in range(expected.shape[0]):
        for b in range(measured.shape[0]):
            o, g = measured[b], expected[k, b]
            if o == -np.inf or np.isnan(o):
                continue
            if scale[k, b] == np.inf:  # unknown beyond g: all ranges beyond are equally likely
                if o < g:
                    total[k, 2] += 1.0
                    total[k, 0] -= math.log((1.0 - unseen) * (flat + short / max(g, 1e-3)))
                elif o < np.inf:
                    total[k, 0] -= math.log((1.0 - unseen) * (flat + (1.0 - short - random) / max(range_max - g, 1.0)))
                else:
                    total[k, 0] -= math.log(unseen)
                continue
            total[k, 2] += 1.0
            if o == np.inf:
                total[k, 0] -= math.log(unseen if g < range_max else 1.0 - unseen)
                total[k, 1] += 0.0 if g < range_max else 1.0
                continue
            if g >= range_max:
                total[k, 0] -= math.log(unseen / range_max)
                continue
            noise, model = sigma * sigma + relative * relative * g * g, scale[k, b] * scale[k, b]
            variance = noise + model + extra_sigma * extra_sigma
            e = o - g
            core = (1.0 - short - random) * math.exp(-0.5 * e * e / variance) / math.sqrt(2 * math.pi * variance)
            early = short / max(g, 1e-3) if o < g else 0.0
            density = core + flat + early
            inlier = core / density
            total[k, 0] -= math.log(density * (1.0 - unseen))
            total[k, 1] += inlier
            weight = inlier / variance
            slope = weight * e - early / (max(g, 1e-3) * density)  # d ln p / dg
            slope += inlier * relative * relative * g * (e * e / variance - 1.0) / variance
            for i in range(3):
                gradient[k, i] += slope * jacobian[k, b, i]
                for j in range(3):
                    outer = jacobian[k, b, i] * jacobian[k, b, j] * weight
                    matrices[k, 0, i, j] += outer
                    matrices[k, 1, i, j] += outer * noise / variance
                    matrices[k, 2, i, j] += outer * model / variance


@jit
def rank_places(panoramas, bins, measured, tolerance, range_max, costs):
    """Fills costs (S, H) of every place and heading with the mean over beams of e² / (e² + tolerance²).

    Shortened beams count less, see `SHORT_MISFIT_FACTOR`.
    """
    size, headings = panoramas.shape[1], costs.shape[1]
    for s in range(panoramas.shape[0]):
        for h in range(headings):
            shift = h * size // headings
            total, used = 0.0, 0
            for b in range(bins.shape[0]):
                o = measured[b]
                if o == -np.inf or np.isnan(o):
                    continue
                g = panoramas[s, (bins[b] + shift) % size]
                if np.isnan(g):
                    total, used = total + UNKNOWN_MISFIT, used + 1
                    continue
                e = min(o, range_max) - min(g, range_max)
                misfit = e * e / (e * e + tolerance * tolerance)
                total += misfit if e > 0.0 else SHORT_MISFIT_FACTOR * misfit
                used += 1
            costs[s, h] = total / max(used, 1)


@jit
def count_crossings(starts, unit, ranges, h, surface, mx, my, nx, ny, margin, crossed):
    """Counts in crossed (ny, nx) the beams that passed through the surface element of each cell.

    Beams have starts (R, 2), unit directions (R, 2) and ranges (R,), in m from node (0, 0). Cells of ``h`` m with
    ``surface`` set have an element with mean (mx, my) and normal (nx, ny). A beam passes through it if it crosses the
    element's plane within the cell, and ends at least ``margin`` m behind it.
    """
    rows, columns = surface.shape
    for b in range(ranges.shape[0]):
        x, y, ux, uy = starts[b, 0] / h, starts[b, 1] / h, unit[b, 0], unit[b, 1]
        j, i = int(x), int(y)
        sx, sy = (1 if ux > 0 else -1), (1 if uy > 0 else -1)
        # Amanatides and Woo 1987: step from cell to cell, across the nearer edge in x or in y.
        ax = ((j + (ux > 0)) - x) / ux if ux != 0.0 else np.inf
        ay = ((i + (uy > 0)) - y) / uy if uy != 0.0 else np.inf
        end, t = ranges[b] / h, 0.0
        while t < end and 0 <= i < rows and 0 <= j < columns:
            out = min(ax, ay)
            if surface[i, j]:
                ex, ey = x + end * ux - mx[i, j] / h, y + end * uy - my[i, j] / h
                depth = ex * nx[i, j] + ey * ny[i, j]
                slope = ux * nx[i, j] + uy * ny[i, j]
                if slope != 0.0 and abs(depth) * h > margin and (depth > 0.0) == (slope > 0.0):
                    at = end - depth / slope
                    if t <= at <= out:
                        crossed[i, j] += 1.0
            t = out
            if ax < ay:
                j, ax = j + sx, ax + abs(1.0 / ux)
            else:
                i, ay = i + sy, ay + abs(1.0 / uy)


@jit
def mark_seen_cells(starts, unit, ranges, h, seen):
    """Marks in ``seen`` the cells of ``h`` m that beams pass.

    Beams have starts (R, 2), unit directions (R, 2) and ranges (R,), in m from node (0, 0).
    """
    rows, columns = seen.shape
    for b in range(ranges.shape[0]):
        for k in range(int(ranges[b] / (0.5 * h)) + 1):
            t = min(0.5 * h * k, ranges[b])
            j, i = int((starts[b, 0] + t * unit[b, 0]) / h), int((starts[b, 1] + t * unit[b, 1]) / h)
            if 0 <= i < rows and 0 <= j < columns:
                seen[i, j] = True


@jit
def end_in_unseen_cells(seen, ox, oy, h, lasers, angles, allowed, ranges, jacobian, scale):
    """Ends each beam where it has passed more than ``allowed`` m of unseen cells, with infinite scale there."""
    rows, columns = seen.shape
    for k in range(lasers.shape[0]):
        for b in range(angles.shape[0]):
            ux, uy = math.cos(lasers[k, 2] + angles[b]), math.sin(lasers[k, 2] + angles[b])
            unseen_length, t, step = 0.0, 0.0, 0.5 * h
            while t < ranges[k, b]:
                x, y = (lasers[k, 0] + t * ux - ox) / h, (lasers[k, 1] + t * uy - oy) / h
                inside = 0 <= x < columns and 0 <= y < rows
                if not inside or not seen[int(y), int(x)]:
                    unseen_length += step
                    if unseen_length > allowed:
                        ranges[k, b], scale[k, b] = t, np.inf
                        jacobian[k, b, :] = 0.0
                        break
                t += step
