"""Poses, worlds and maps, and exact ray casting."""
