"""What the commands do, as functions: decide a study of recordings, tune, compare, and the page."""
