"""The verb `capture`: receive photographs from a phone's browser, and answer each at once."""
