"""Models of components, and where a library of them stands in an analysed scene."""
