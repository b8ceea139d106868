//! How many may be inside: in total, and of one kind.
//!
//! Invariant: what was taken is given back when its [`Slot`] is dropped, also by a panic; a kind of which nobody is inside costs no memory.
//! Used for connections by network, for requests by principal, and for both of who has not shown yet who it is.

use midshift_core::overload::Class;
use std::collections::HashMap;
use std::hash::Hash;
use std::net::{IpAddr, Ipv6Addr};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

/// Which limit was reached.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Full {
    /// Of all.
    Total,
    /// Of this kind.
    Kind,
}

/// How many of one kind may be inside.
#[derive(Clone, Copy, Debug)]
enum Each {
    /// So many.
    Most(usize),
    /// This part of what the others leave, rounded up: however many one kind has, another finds room, and the more kinds there are the less each of them gets.
    OfOthers { part: usize, of: usize },
}

#[derive(Debug)]
struct SlotsTaken<K> {
    total: usize,
    kinds: HashMap<K, usize>,
}

#[derive(Debug)]
pub(crate) struct Quota<K> {
    total_max: usize,
    each: Each,
    taken: Mutex<SlotsTaken<K>>,
}

/// One who is inside.
#[derive(Debug)]
pub(crate) struct Slot<K: Eq + Hash> {
    kind: K,
    of: Arc<Quota<K>>,
}

impl<K: Eq + Hash + Clone> Quota<K> {
    pub fn new(total_max: usize, kind_max: usize) -> Arc<Self> {
        Self::with(total_max, Each::Most(kind_max))
    }

    /// Of which one kind has no more than this part of what the others leave.
    pub fn sharing(total_max: usize, part: usize, of: usize) -> Arc<Self> {
        Self::with(total_max, Each::OfOthers { part: part.min(of).max(1), of: of.max(1) })
    }

    fn with(total_max: usize, each: Each) -> Arc<Self> {
        let taken = Mutex::new(SlotsTaken { total: 0, kinds: HashMap::new() });
        Arc::new(Self { total_max, each, taken })
    }

    /// A slot for something of this class, or which limit is reached: the last slots, of all and of each kind, are for higher classes.
    pub fn claim(self: &Arc<Self>, kind: K, class: Class) -> Result<Slot<K>, Full> {
        let mut taken = self.taken();
        let free = class.share(self.total_max).saturating_sub(taken.total);
        if free == 0 {
            return Err(Full::Total);
        }
        let own = taken.kinds.get(&kind).copied().unwrap_or(0);
        let most = match self.each {
            Each::Most(most) => class.share(most),
            Each::OfOthers { part, of } => (free + own).saturating_mul(part).div_ceil(of),
        };
        if own >= most {
            return Err(Full::Kind);
        }
        taken.total += 1;
        *taken.kinds.entry(kind.clone()).or_insert(0) += 1;
        Ok(Slot { kind, of: self.clone() })
    }
}

impl<K> Quota<K> {
    fn taken(&self) -> MutexGuard<'_, SlotsTaken<K>> {
        self.taken.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl<K: Eq + Hash> Drop for Slot<K> {
    fn drop(&mut self) {
        let mut taken = self.of.taken();
        taken.total -= 1;
        let left = taken.kinds.get_mut(&self.kind).map_or(0, |count| {
            *count -= 1;
            *count
        });
        if left == 0 {
            taken.kinds.remove(&self.kind);
        }
    }
}

/// Whom an address stands for: an IPv4 address for itself, one of IPv6 for its /64, which any single machine has to itself.
pub(crate) fn network(address: IpAddr) -> IpAddr {
    match address.to_canonical() {
        IpAddr::V4(v4) => v4.into(),
        IpAddr::V6(v6) => Ipv6Addr::from(u128::from(v6) & !u128::from(u64::MAX)).into(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn one_kind_fills_its_own_seats_and_leaves_the_others() {
        let slots = Quota::new(3, 2);
        let first = slots.claim("a", Class::Stop).expect("room");
        let _second = slots.claim("a", Class::Stop).expect("room");
        assert_eq!(slots.claim("a", Class::Stop).err(), Some(Full::Kind));
        let _other = slots.claim("b", Class::Stop).expect("room for another kind");
        assert_eq!(slots.claim("c", Class::Stop).err(), Some(Full::Total));
        drop(first);
        let _again = slots.claim("a", Class::Stop).expect("a slot that was given back");
    }

    #[test]
    fn kinds_that_share_leave_room_for_one_more_kind_however_greedy_they_are() {
        let slots = Quota::sharing(4_096, 1, 4);
        let mut inside = Vec::new();
        let mut fill = |kind: u32| {
            let before = inside.len();
            while let Ok(slot) = slots.claim(kind, Class::Stop) {
                inside.push(slot);
            }
            inside.len() - before
        };
        assert_eq!(fill(0), 1_024, "alone it has a quarter");
        let four: usize = (1..4).map(&mut fill).sum();
        assert!((1_200..2_000).contains(&four), "{four}");
        for kind in 4..24 {
            assert!(fill(kind) > 0, "kind {kind} finds no room");
        }
        assert_eq!(Quota::sharing(1, 4, 16).claim(0, Class::Stop).map(drop), Ok(()));
    }

    #[test]
    fn the_lowest_class_is_shed_first_and_the_highest_last() {
        let slots = Quota::new(10, 10);
        let mut inside = Vec::new();
        let mut fill = |class| {
            while let Ok(slot) = slots.claim("a", class) {
                inside.push(slot);
            }
            inside.len()
        };
        assert_eq!(Class::ALL.map(&mut fill), [6, 7, 8, 9, 10]);
        inside.truncate(6);
        assert_eq!(slots.claim("b", Class::Bulk).err(), Some(Full::Total));
        assert!(slots.claim("b", Class::Status).is_ok());
    }

    #[test]
    fn nothing_is_kept_of_those_who_left() {
        let slots = Quota::new(10, 10);
        for kind in 0..1000 {
            drop(slots.claim(kind, Class::Stop).expect("room"));
        }
        let taken = slots.taken();
        assert_eq!((taken.total, taken.kinds.len()), (0, 0));
    }

    #[test]
    fn a_machine_is_one_network_however_many_addresses_it_has() {
        let network = |text: &str| super::network(text.parse().expect("an address"));
        assert_eq!(network("2001:db8:1:2::1"), network("2001:db8:1:2:ffff::9"));
        assert_ne!(network("2001:db8:1:2::1"), network("2001:db8:1:3::1"));
        assert_eq!(network("::ffff:192.0.2.7"), network("192.0.2.7"));
        assert_ne!(network("192.0.2.7"), network("192.0.2.8"));
    }
}
