"""Evaluation of choices, machine libraries, conformance of engines: what makes and checks the product's numbers."""
