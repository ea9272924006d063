"""Studies, robustness, reports and certificates of trained policies."""
