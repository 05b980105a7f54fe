"""Messages that the gateway itself sends: replies to queries and commands, the list of links, pings."""
