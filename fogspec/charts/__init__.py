"""Draw charts: pure functions of their arguments that return the same bytes for the same data.

Charts are SVG without scripts, which follows the light or dark setting and is legible at 600 px.
"""
