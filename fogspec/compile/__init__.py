"""Compile a spec, a catalog and measurements to the files derived from them."""
