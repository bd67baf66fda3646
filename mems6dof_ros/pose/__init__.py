"""From localizations to the pose of rigid bodies in six degrees of freedom."""
