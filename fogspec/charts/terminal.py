"""Draw the menu chart in plain characters, for terminals of any width, with or without color."""

from collections.abc import Sequence

import numpy as np

from fogspec.base.console import styled
from fogspec.charts.axes import Axis, axis
from fogspec.charts.chart import Chart, View, per_hour, per_request, y_axis, y_words

ROWS = 13
SIDE = 9  # columns of the vertical axis
NARROWEST, WIDEST, GAP = 44, 84, 3
STYLES: dict[str, dict[str, str | bool]] = {
    "@": {"fg": "red", "bold": True},
    "1": {"bold": True},
    "2": {"bold": True},
    "#": {"fg": "blue", "bold": True},
    "o": {"bold": True},
    "-": {"fg": "blue"},
    "|": {"fg": "blue"},
    "+": {"fg": "blue"},
    "%": {"fg": "red"},
    ".": {"dim": True},
    ":": {},
}

Grid = list[list[str]]


def plot(chart: Chart, width: int, color: bool = False) -> list[str]:
    """Return the lines of the chart, at most `width` characters wide, with both views side by side if they fit.

    The chart has at least 44 columns.
    """
    views = [per_request(chart), per_hour(chart)]
    beside = width >= 2 * NARROWEST + 12 + GAP
    each = min(max((width - GAP) // 2 if beside else width, NARROWEST), WIDEST)
    drawn = [_view(chart, view, each, color) for view in views]
    joined = [left + " " * GAP + right for left, right in zip(*drawn, strict=True)]
    lines = joined if beside else [*drawn[0], "", *drawn[1]]
    return [line.rstrip() for line in [*lines, *_key(chart)]]


def _view(chart: Chart, view: View, width: int, color: bool) -> list[str]:
    columns = width - SIDE
    x, y = axis(view.everything(chart)[0], 0, columns - 1), y_axis(chart, ROWS - 1, 0)
    grid: Grid = [[" "] * columns for _ in range(ROWS)]
    _crowd(grid, x, y, chart, view)
    _limits(grid, x, y, view)
    _stairs(grid, x, y, view.steps(chart))
    _named(grid, x, y, chart, view)
    ticks = {round(at): words for at, words in y.ticks(y_words(chart), lambda _: 2.0)}
    lines = [f"{view.heading}: {chart.y_label}".ljust(width)[:width]]
    for row, cells in enumerate(grid):
        mark = f"{ticks.get(row, '')[: SIDE - 2]:>{SIDE - 2}} {'+' if row in ticks else '|'}"
        lines.append(mark + "".join(_styled(cell, color) for cell in cells))
    across = x.ticks(view.x_words, lambda words: len(words) + 2.0)
    marks = {round(at) for at, _ in across}
    lines.append(" " * (SIDE - 1) + "+" + "".join("+" if at in marks else "-" for at in range(columns)))
    lines.append((" " * SIDE + _words_under(across, columns)).ljust(width)[:width])
    lines.append(view.x_label.rjust(width)[:width])
    return lines


def _styled(cell: str, color: bool) -> str:
    return styled(cell, **STYLES[cell]) if color and cell != " " else cell


def _crowd(grid: Grid, x: Axis, y: Axis, chart: Chart, view: View) -> None:
    at = np.rint(_places(view.column(chart), x)).astype(int), np.rint(_places(chart.crowd.y, y)).astype(int)
    for meets, sign in ((False, "."), (True, ":")):
        rows = chart.crowd.meets == meets
        for column, row in set(zip(at[0][rows].tolist(), at[1][rows].tolist(), strict=True)):
            grid[row][column] = sign


def _places(values: np.ndarray, axis: Axis) -> np.ndarray:
    return np.asarray(axis.start + (np.log10(values) - axis.low) / (axis.high - axis.low) * (axis.end - axis.start))


def _limits(grid: Grid, x: Axis, y: Axis, view: View) -> None:
    """Draw `%` along the inner edge of the forbidden regions."""

    def over(row: int, column: int) -> bool:
        log_x = x.low + (column - x.start) / (x.end - x.start) * (x.high - x.low)
        log_y = y.low + (row - y.start) / (y.end - y.start) * (y.high - y.low)
        return any(one.a * log_x + one.b * log_y > one.most for one in view.bounds)

    rows, columns = len(grid), len(grid[0])
    for row in range(rows):
        for column in range(columns):
            if not over(row, column):
                continue
            if (row + 1 < rows and not over(row + 1, column)) or (column > 0 and not over(row, column - 1)):
                grid[row][column] = "%"


def _stairs(grid: Grid, x: Axis, y: Axis, steps: Sequence[tuple[float, float]]) -> None:
    above = 0
    for i, (cost, height) in enumerate(steps):
        column, row = round(x.at(cost)), round(y.at(height))
        end = round(x.at(steps[i + 1][0])) if i + 1 < len(steps) else len(grid[0]) - 1
        for line in range(above, row):
            grid[line][column] = "|"
        for across in range(column, end + 1):
            grid[row][across] = "-"
        above = row


def _named(grid: Grid, x: Axis, y: Axis, chart: Chart, view: View) -> None:
    signs = _signs(chart)
    order = {"#": 0, "o": 1, "2": 2, "1": 3, "@": 4}
    found = []
    for machine in chart.machines:
        plain = "o" if machine.measured else "#" if getattr(machine, view.front) else None
        sign = signs.get(machine.role) or plain
        if sign:
            found.append((order[sign], round(y.at(machine.y)), round(x.at(getattr(machine, view.x))), sign))
    for _, row, column, sign in sorted(found):
        grid[row][column] = sign


def _signs(chart: Chart) -> dict[str, str]:
    """Return the sign of each role: `@` for the choice, digits for other highlighted machines."""
    roles = [machine.role for machine in chart.machines if machine.role]
    others = [role for role in roles if role != "chosen"]
    return {"chosen": "@", **{role: str(i + 1) for i, role in enumerate(others[:2])}}


def _words_under(ticks: Sequence[tuple[float, str]], columns: int) -> str:
    line = [" "] * columns
    for at, words in ticks:
        start = min(max(round(at) - len(words) // 2, 0), columns - len(words))
        line[start : start + len(words)] = words
    return "".join(line)


def _key(chart: Chart) -> list[str]:
    signs = [f"{sign} {role}" for role, sign in _signs(chart).items() if any(m.role == role for m in chart.machines)]
    if any(machine.measured for machine in chart.machines):
        signs.append("o measured")
    limited = any(bool(view.bounds) for view in (per_request(chart), per_hour(chart)))
    signs += ["# Pareto front", ": meets the limits" if limited else ": any other machine"]
    if limited:
        signs += [". does not", "% edge of a limit"]
    lines = [""]
    for words in signs:
        if len(lines[-1]) + len(words) + 3 > NARROWEST + 30 and lines[-1]:
            lines.append("")
        lines[-1] += ("   " if lines[-1] else "") + words
    return lines
