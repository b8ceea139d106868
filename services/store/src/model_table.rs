//! One table of the in-memory model, with the three orders that lists need. Used by [`crate::MemoryStore`] alone.
//!
//! Invariant: every row is in `rows` and in each order that its index columns put it in, and nowhere else.

use crate::{Cursor, Query};
use midshift_core::rows::{Index, Row};
use std::collections::{BTreeMap, BTreeSet};
use std::ops::Bound;
use std::sync::Arc;

type Order = BTreeSet<Cursor>;

#[derive(Default)]
pub(crate) struct Rows {
    rows: BTreeMap<Arc<str>, Row>,
    by_order: Order,
    by_parent: BTreeMap<Arc<str>, Order>,
    by_state: BTreeMap<i64, Order>,
}

impl Rows {
    pub(crate) fn get(&self, id: &str) -> Option<&Row> {
        self.rows.get(id)
    }

    pub(crate) fn iter(&self) -> impl Iterator<Item = &Row> {
        self.rows.values()
    }

    /// Rows in one of these states, each state by its own order.
    pub(crate) fn in_states(&self, states: &[i64]) -> impl Iterator<Item = &Row> {
        let orders = states.iter().filter_map(|state| self.by_state.get(state));
        orders.flatten().filter_map(|place| self.rows.get(&place.id))
    }

    /// Rows of one parent, by their order.
    pub(crate) fn of_parent(&self, parent: &str) -> impl Iterator<Item = &Row> {
        self.by_parent.get(parent).into_iter().flatten().filter_map(|place| self.rows.get(&place.id))
    }

    pub(crate) fn insert(&mut self, row: Row) {
        let place = Cursor::of_row(&row);
        let index = row.index.clone();
        match self.rows.insert(row.key.id.clone(), row) {
            Some(old) if old.index == index => return,
            Some(old) => self.unlink(&Cursor::of_row(&old), &old.index),
            None => {}
        }
        if let Some(parent) = index.parent {
            self.by_parent.entry(parent).or_default().insert(place.clone());
        }
        if let Some(state) = index.state {
            self.by_state.entry(state).or_default().insert(place.clone());
        }
        self.by_order.insert(place);
    }

    pub(crate) fn delete(&mut self, id: &str) {
        if let Some(old) = self.rows.remove(id) {
            self.unlink(&Cursor::of_row(&old), &old.index);
        }
    }

    /// Takes rows out from the lowest order on.
    pub(crate) fn delete_up_to(&mut self, order: i64) {
        while let Some(place) = self.by_order.first().filter(|place| place.order <= order) {
            let id = place.id.clone();
            self.delete(&id);
        }
    }

    fn unlink(&mut self, place: &Cursor, index: &Index) {
        self.by_order.remove(place);
        if let Some(parent) = &index.parent {
            remove_from(&mut self.by_parent, parent, place);
        }
        if let Some(state) = &index.state {
            remove_from(&mut self.by_state, state, place);
        }
    }

    pub(crate) fn list(&self, query: &Query) -> Vec<Row> {
        let limit = query.rows_max();
        let fits = |row: &&Row| {
            (query.states.is_empty() || row.index.state.is_some_and(|s| query.states.contains(&s)))
                && (query.parent.is_none() || row.index.parent == query.parent)
        };
        if let Some(prefix) = &query.id_prefix {
            return self.of_prefix(prefix, query).filter(fits).take(limit).cloned().collect();
        }
        let empty = Order::new();
        let orders: Vec<&Order> = match &query.parent {
            Some(parent) => vec![self.by_parent.get(parent).unwrap_or(&empty)],
            None if query.states.is_empty() => vec![&self.by_order],
            None => {
                let states: BTreeSet<i64> = query.states.iter().copied().collect();
                states.iter().filter_map(|state| self.by_state.get(state)).collect()
            }
        };
        let mut places: Vec<(&Cursor, &Row)> = Vec::new();
        for order in orders {
            let rows = walk(order, query).filter_map(|place| Some((place, self.rows.get(&place.id)?)));
            places.extend(rows.filter(|(_, row)| fits(row)).take(limit));
        }
        places.sort_unstable_by(|a, b| if query.newest_first { b.0.cmp(a.0) } else { a.0.cmp(b.0) });
        places.into_iter().take(limit).map(|(_, row)| row.clone()).collect()
    }

    /// By id, in the direction of the list.
    fn of_prefix<'a>(&'a self, prefix: &str, query: &'a Query) -> Box<dyn Iterator<Item = &'a Row> + 'a> {
        let behind = query.behind_prefix();
        let end = behind.as_deref().map_or(Bound::Unbounded, Bound::Excluded);
        let rows = self.rows.range::<str, _>((Bound::Included(prefix), end)).map(|(_, row)| row);
        let after = query.after.as_ref().map(|place| &place.id);
        if query.newest_first {
            Box::new(rows.rev().filter(move |row| after.is_none_or(|after| row.key.id < *after)))
        } else {
            Box::new(rows.filter(move |row| after.is_none_or(|after| row.key.id > *after)))
        }
    }
}

fn walk<'a>(order: &'a Order, query: &Query) -> Box<dyn Iterator<Item = &'a Cursor> + 'a> {
    let after = query.after.clone().map_or(Bound::Unbounded, Bound::Excluded);
    if query.newest_first {
        Box::new(order.range((Bound::Unbounded, after)).rev())
    } else {
        Box::new(order.range((after, Bound::Unbounded)))
    }
}

fn remove_from<K: Ord>(orders: &mut BTreeMap<K, Order>, key: &K, place: &Cursor) {
    if let Some(order) = orders.get_mut(key) {
        order.remove(place);
        if order.is_empty() {
            orders.remove(key);
        }
    }
}
