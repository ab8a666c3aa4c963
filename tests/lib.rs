//! What the whole-system tests have in common.
