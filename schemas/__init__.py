"""What crosses a process boundary: messages, topics, frames and units, and their codec."""
