"""What the verbs take and what they answer: strict models with units in the names, which the API document shows."""
