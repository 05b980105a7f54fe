"""Where edges, gateway, recorder and player are wired together: the only modules that know them all."""
