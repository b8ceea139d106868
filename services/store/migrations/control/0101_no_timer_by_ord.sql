DROP INDEX timer_by_ord
