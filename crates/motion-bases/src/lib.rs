//! motion-bases
