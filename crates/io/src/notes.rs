//! What is told of a scene besides what is wrong with it.

/// Adds a sentence. Many files have the same to tell: it is told once.
pub(crate) fn note(notes: &mut Vec<String>, text: impl Into<String>) {
    let text = text.into();
    if !notes.contains(&text) {
        notes.push(text);
    }
}
