"""Files that are not to be trusted: what their headers claim, where paths lead, and the reasons they are refused for."""
