"""Models of the verbs' requests and answers, strict and with units in the names; the API document shows them."""
