"""Pictures: pure functions of their arguments that give the same bytes for the same data.

SVG without script that follows the reader's light or dark setting and is legible at 600 px, and plain characters.
"""
