"""The paper's own figures: its tables as data, what can be read off them, and which of its findings hold here."""
