"""The report of a mission: `report.json` for programs, and `report.html` with pictures for people."""
