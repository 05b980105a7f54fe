"""De-identification of sessions: a profile and rules that change the inputs; the gateway computes the outputs again.

``session`` reads and writes files.  ``rules`` is the table, ``profile`` what a user may keep, ``context`` what they
share.  ``messages`` has the rules for OpenIGTLink, ``ros`` those for ROS, ``notes`` those for links and notes,
``configuration`` those for settings, ``pixels`` those for pictures.
"""
