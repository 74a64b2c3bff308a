//! The front door: which layout a folder has.

use std::collections::BTreeSet;
use std::path::Path;

use crate::layouts::LAYOUTS;
use crate::load::load;
use crate::{IoError, LoadOptions, Scene};

impl Scene {
    /// Opens a scene as it is; see [`Scene::open_with`].
    ///
    /// # Errors
    /// As [`Scene::open_with`].
    pub fn open(dir: &Path) -> Result<Self, IoError> {
        Self::open_with(dir, &LoadOptions::default())
    }

    /// Opens a folder in any layout that is known; nerfstudio's `transforms.json` wins where several are
    /// there.
    ///
    /// # Errors
    /// [`IoError::Unrecognised`] says what was looked for; [`IoError::Invalid`] is for a file; everything else that is missing, broken,
    /// of the wrong size, or distorted where that is refused, has its own variant and names the file.
    pub fn open_with(dir: &Path, options: &LoadOptions) -> Result<Self, IoError> {
        if options.downscale == 0 {
            return Err(IoError::invalid(dir, "downscale must be at least 1"));
        }
        let root = dir.canonicalize().map_err(|e| IoError::access(dir, e))?;
        if root.is_file() {
            let what = "this is a file, and a scene is a folder; give the folder that it is in";
            return Err(IoError::invalid(dir, what));
        }
        match LAYOUTS.iter().find(|layout| layout.recognises(&root)) {
            Some(layout) => {
                let plan = (layout.plan)(&root, options)?;
                load(root, layout.name, plan, options)
            }
            None => Err(unrecognised(dir)),
        }
    }
}

fn unrecognised(dir: &Path) -> IoError {
    let looked_for = LAYOUTS.map(|layout| {
        let parts = layout.looks_for.join(" with ");
        format!("{parts} ({})", layout.name)
    });
    let found: BTreeSet<_> = LAYOUTS.iter().flat_map(|l| l.found(dir)).collect();
    let found = if found.is_empty() {
        "nothing of it".to_owned()
    } else {
        format!("only {}", Vec::from_iter(found).join(", "))
    };
    IoError::Unrecognised {
        looked_for: format!("looked for {}; found {found}", looked_for.join(", or ")),
        path: dir.into(),
    }
}
