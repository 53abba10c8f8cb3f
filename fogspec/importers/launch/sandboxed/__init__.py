"""What runs in the sandbox: stand-ins for `launch` and what is used with it, which record what would start."""
