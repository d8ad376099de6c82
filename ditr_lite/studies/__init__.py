"""Studies: one question each, answered on the rendered scenes; ``tools`` runs the long ones and writes their files."""
