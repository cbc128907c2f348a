"""What happens when something dies, freezes, is cut off or does what it should not: faults into a running system."""
