//! Which templates the tracker remembers (spec 3.9). The tokens themselves lie in the engine's
//! slots; here is what they were made from.

use crate::geometry::{BBox, Modality, Yx};

/// What a template was made from.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Template {
    /// Frame number, 0 for the annotated frame.
    pub frame: u64,
    /// Sensor of the frame, where the caller said so. Nothing is decided by it.
    pub modality: Option<Modality>,
    /// Target in pixels of the template's crop (pixel-centre convention, spec 3.6).
    pub bbox: BBox,
    /// Offset of the target from the middle of the map, in cells.
    pub label_centre: Yx,
    /// Score of the frame; 1 for the annotated frame.
    pub score: f32,
}

/// Template slots of at most `N`, of which `limit` are used.
///
/// Slot 0 is the annotated frame and is never replaced. While slots are free a new template takes
/// the next one; then it replaces the oldest but the first. With two slots this is the reference's
/// rule: the annotated frame and the most recent confident frame.
#[derive(Clone, Debug, PartialEq)]
pub struct TemplateMemory<const N: usize> {
    slots: heapless::Vec<Template, N>,
    limit: usize,
}

impl<const N: usize> TemplateMemory<N> {
    /// An empty memory of `limit` slots (at most `N`).
    pub fn new(limit: usize) -> Self {
        Self { slots: heapless::Vec::new(), limit: limit.min(N) }
    }

    /// Slot the next template goes to; `None` when there is only room for the first one.
    pub fn next_slot(&self) -> Option<usize> {
        if self.slots.len() < self.limit {
            return Some(self.slots.len());
        }
        let later = self.slots.iter().enumerate().skip(1);
        later.min_by_key(|(_, t)| t.frame).map(|(slot, _)| slot)
    }

    /// Remembers what [`Self::next_slot`] was filled with; returns that slot.
    pub fn record(&mut self, template: Template) -> Option<usize> {
        let slot = self.next_slot()?;
        match self.slots.get_mut(slot) {
            Some(old) => *old = template,
            // `next_slot` is below the capacity.
            None => self.slots.push(template).ok()?,
        }
        Some(slot)
    }

    /// Forgets everything.
    pub fn clear(&mut self) {
        self.slots.clear();
    }

    /// Filled slots, in slot order.
    pub fn templates(&self) -> &[Template] {
        &self.slots
    }

    /// Number of filled slots.
    pub fn filled(&self) -> usize {
        self.slots.len()
    }

    /// Number of slots there are.
    pub const fn limit(&self) -> usize {
        self.limit
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn template(frame: u64) -> Template {
        Template {
            frame,
            modality: None,
            bbox: BBox::default(),
            label_centre: Yx::default(),
            score: 1.0,
        }
    }

    proptest! {
        #[test]
        fn the_first_stays_and_the_newest_are_kept(limit in 1usize..=8, frames in 1u64..40) {
            let mut memory = TemplateMemory::<8>::new(limit);
            for frame in 0..frames {
                let expected = memory.next_slot();
                prop_assert_eq!(memory.record(template(frame)), expected);
                prop_assert_eq!(expected.is_some(), frame == 0 || limit > 1);
            }
            let mut held: Vec<u64> = memory.templates().iter().map(|t| t.frame).collect();
            prop_assert_eq!(held[0], 0);
            held.sort_unstable();
            let newest = frames.saturating_sub(limit as u64 - 1).max(1)..frames;
            prop_assert_eq!(held, [0].into_iter().chain(newest).collect::<Vec<_>>());
        }
    }

    #[test]
    fn a_memory_can_be_emptied_and_never_exceeds_its_type() {
        let mut memory = TemplateMemory::<2>::new(9);
        assert_eq!(memory.limit(), 2);
        for frame in 0..5 {
            memory.record(template(frame));
        }
        assert_eq!(memory.filled(), 2);
        memory.clear();
        assert_eq!((memory.filled(), memory.next_slot()), (0, Some(0)));
        assert_eq!(TemplateMemory::<2>::new(0).record(template(0)), None);
    }
}
