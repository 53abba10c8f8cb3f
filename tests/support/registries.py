"""A user of a private registry, and the line that Debian's docker-registry reads of it."""

USER, PASSWORD = "reader", "not-a-real-secret"
HTPASSWD = f"{USER}:$2b$04$o40LmoTR3DxIUNKeoMt0d.R23nwVDY9JwJT8KlnXpg9jWL2NG3G6a\n"
