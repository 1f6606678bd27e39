"""Stage two: replay or listen, select every second, switch, compare."""
