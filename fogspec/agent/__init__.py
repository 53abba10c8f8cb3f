"""What runs on a measured machine, by itself: standard library only, imported by nothing else here."""
