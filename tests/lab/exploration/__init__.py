"""Tests of lab.exploration."""
