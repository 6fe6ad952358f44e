"""Experiments on `mjxgrad`: one TOML file per run, their runner and their report."""
