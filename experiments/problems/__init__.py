"""Problems and instruments that experiments share and the library does not need: each file is usable alone."""
