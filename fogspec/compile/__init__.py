"""From a spec, a catalog and measurements to the files that follow from them."""
