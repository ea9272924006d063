"""Episodes of actions that no policy should send: a module for each task that is tried."""

STRESSED = {"BncConnector": "bnc_connector", "NarrowPassage": "narrow_passage", "Pouring": "pouring"}
