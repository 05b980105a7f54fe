"""What the gateway says on its own account: replies to queries and commands, links, ticks."""
