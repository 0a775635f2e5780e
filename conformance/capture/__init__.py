"""Reads capture files and judges them: packets, frames, transactions of each SubDevice."""
