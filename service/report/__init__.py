"""What a mission leaves behind: `report.json` for programs, `report.html` with pictures for people."""
