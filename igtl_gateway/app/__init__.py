"""Connects edges, gateway, recorder and player to whole programs.  Only these modules import all of them."""
