"""The language's own documents, made from its types: JSON Schemas and reference pages."""
