"""Trained policies in their environments: what evaluation and rendering share."""
