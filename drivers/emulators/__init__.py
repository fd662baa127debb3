"""The far side of each wire: real protocols answered with what any HAL device says, with fault injection."""
