"""A uniform grid over points that finds the nearest point in constant time, with the same result as trying all points.

A grid is one float64 array, so that worlds can store theirs as rows of a batch: a header, then the next point in the same cell
for every point, then the first point of every cell. It is a linked cell list with about one point per cell. If a grid cannot help
(numbers that are not finite, a query from far away), all points are tried, so a grid changes the cost of a query, never its
result.
"""

import numpy as np

from marlbc_mj.core.laws import allocation_free, compiled

_COLUMNS, _ROWS, _X, _Y, _SIZE, _WIDEST, _HEADER = 0, 1, 2, 3, 4, 5, 6
LARGEST = 1e12  # no grid is built if coordinates or radii exceed this [m]
FARTHEST = 1e6  # [cells] a query from farther away tries all points
SLACK = 1e-6  # [cells] rounding error that may put a point into an adjacent cell
WORTH = 2048
"""Number of query-point pairs above which building a grid pays off. Measured against trying all pairs, it costs the same at 1 000
pairs, a third at 16 000, and a tenth at 65 000."""


@allocation_free
def room(points):
    """Length of the array for a grid of that number of points."""
    return _HEADER + 4 * points + 8


@allocation_free
def fill(points, grid):
    """Sort ``points`` (n, 2 or more; a third column is a radius) into ``grid`` (room(n),), in place; O(n)."""
    n = points.shape[0]
    grid[_COLUMNS] = 0.0
    if n == 0:
        return
    sized = points.shape[1] > 2
    low_x, high_x, low_y, high_y, widest = points[0, 0], points[0, 0], points[0, 1], points[0, 1], 0.0
    for k in range(n):
        radius = points[k, 2] if sized else 0.0
        if not abs(points[k, 0]) + abs(points[k, 1]) + abs(radius) < LARGEST:
            return
        low_x, high_x = min(low_x, points[k, 0]), max(high_x, points[k, 0])
        low_y, high_y = min(low_y, points[k, 1]), max(high_y, points[k, 1])
        widest = max(widest, radius)
    width, height = high_x - low_x, high_y - low_y
    size = max(np.sqrt(width * height / n), max(width, height) / n)
    if size < 1e-9:
        size = 1.0
    columns, rows = int(width / size) + 1, int(height / size) + 1
    if _HEADER + n + columns * rows > grid.shape[0]:
        return
    grid[_COLUMNS], grid[_ROWS], grid[_X], grid[_Y], grid[_SIZE], grid[_WIDEST] = columns, rows, low_x, low_y, size, widest
    following, first = grid[_HEADER : _HEADER + n], grid[_HEADER + n :]
    for cell in range(columns * rows):
        first[cell] = -1.0
    for k in range(n):
        column = min(int((points[k, 0] - low_x) / size), columns - 1)
        row = min(int((points[k, 1] - low_y) / size), rows - 1)
        following[k] = first[row * columns + column]
        first[row * columns + column] = k


@allocation_free
def nearest(p, points, grid, own):
    """Index k with the least |p - points_k| - radius_k, the lowest index on ties; -1 if there is no point.

    Args:
        p: (2,) [m].
        points: (n, 2 or more), the points in ``grid``; a third column is the radius [m], which is 0 without one.
        grid: filled by :func:`fill`; if it is empty, all points are tried.
        own: index of a point to skip, -1 for none.
    """
    n = points.shape[0]
    columns = int(grid[_COLUMNS]) if grid.shape[0] > 0 else 0
    if columns == 0:
        return _of_all(p, points, own)
    rows, size = int(grid[_ROWS]), grid[_SIZE]
    x, y = np.floor((p[0] - grid[_X]) / size), np.floor((p[1] - grid[_Y]) / size)
    if not abs(x) + abs(y) < FARTHEST:
        return _of_all(p, points, own)
    column, row = int(x), int(y)
    following, first = grid[_HEADER : _HEADER + n], grid[_HEADER + n :]
    ring = max(0, -column, column - columns + 1, -row, row - rows + 1)
    last = max(column, columns - 1 - column, row, rows - 1 - row)
    best, found = np.inf, -1
    while ring <= last and (ring - 1 - SLACK) * size - grid[_WIDEST] <= best:
        for r in range(max(row - ring, 0), min(row + ring, rows - 1) + 1):
            whole = r == row - ring or r == row + ring  # first and last row of the ring; of the other rows only both ends
            for c in range(max(column - ring, 0), min(column + ring, columns - 1) + 1):
                if whole or c == column - ring or c == column + ring:
                    k = int(first[r * columns + c])
                    while k >= 0:
                        gap = _gap(p, points, k)
                        if k != own and (gap < best or (gap == best and k < found)):
                            best, found = gap, k
                        k = int(following[k])
        ring += 1
    return found


@allocation_free
def _of_all(p, points, own):
    """The result of :func:`nearest`, found by trying all points."""
    best, found = np.inf, -1
    for k in range(points.shape[0]):
        gap = _gap(p, points, k)
        if k != own and gap < best:
            best, found = gap, k
    return found


@allocation_free
def _gap(p, points, k):
    x, y = p[0] - points[k, 0], p[1] - points[k, 1]
    distance = np.sqrt(x * x + y * y)
    return distance - points[k, 2] if points.shape[1] > 2 else distance


@compiled
def _fill_spacing(positions, grid, out):
    for m in range(positions.shape[0]):
        team = positions[m]
        if grid.shape[0] > 0:
            fill(team, grid)
        for i in range(team.shape[0]):
            k = nearest(team[i], team, grid, i)
            out[m, i] = _gap(team[i], team, k) if k >= 0 else np.inf


def spacing(positions: np.ndarray) -> np.ndarray:
    """Distance of every agent from its nearest neighbor [m]: (..., N) from ``positions`` (..., N, 2) [m]."""
    teams = np.ascontiguousarray(positions, dtype=np.float64).reshape(-1, *np.shape(positions)[-2:])
    agents = teams.shape[1]
    out = np.empty(teams.shape[:2])
    _fill_spacing(teams, np.empty(room(agents) if agents * agents > WORTH else 0), out)
    return out.reshape(np.shape(positions)[:-1])
