//! unseen-views
