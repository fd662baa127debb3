"""An example: a driver that lives outside panelwright's tree."""
