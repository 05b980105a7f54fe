/* Turns of links in the thread that reads them, as in edges/tcp/turns.py; all of that thread alone. */
#ifndef IGTL_GATEWAY_PASSAGE_TURNS_H
#define IGTL_GATEWAY_PASSAGE_TURNS_H

#include "_reading.h"

#define PART 8 /* of its time that a turn costs which leaves nothing */

/* Have a turn; of the reading thread alone, as the two that follow. */
static void ask_for_turn(Passage *passage, Link *self)
{
    if (atomic_load_explicit(&self->waits, memory_order_relaxed))
        return;
    atomic_store_explicit(&self->waits, 1, memory_order_relaxed);
    if (self->turn_ns < passage->turn_ns)
        self->turn_ns = passage->turn_ns;
    self->next_waiting = NULL;
    Link **at = &passage->waiting; /* behind those that are not later */
    while (*at && (*at)->turn_ns <= self->turn_ns)
        at = &(*at)->next_waiting;
    self->next_waiting = *at;
    *at = self;
}

static void leave_turns(Passage *passage, Link *self)
{
    for (Link **at = &passage->limited; *at; at = &(*at)->next_limited)
        if (*at == self) {
            *at = self->next_limited;
            break;
        }
    self->is_listed = 0;
    for (Link **at = &passage->waiting; *at; at = &(*at)->next_waiting)
        if (*at == self) {
            *at = self->next_waiting;
            break;
        }
    atomic_store_explicit(&self->waits, 0, memory_order_relaxed);
}

/* Let links whose pause is over have their turns; return the time (ms) until the next pause ends, -1: there is none. */
static int end_pauses(Passage *passage)
{
    int64_t now_ns = passage->limited ? clock_ns(CLOCK_MONOTONIC) : 0, least_ns = -1;
    for (Link **at = &passage->limited; *at;) {
        Link *link = *at;
        int64_t left_ns = link->pause_ends_ns - now_ns;
        if (left_ns > 0) {
            if (least_ns < 0 || left_ns < least_ns)
                least_ns = left_ns;
            at = &link->next_limited;
            continue;
        }
        *at = link->next_limited;
        link->is_listed = 0;
        pthread_mutex_lock(&link->reading);
        int reads_on = link->is_limited && link->reader == NATIVE;
        if (reads_on) { /* else Python has it, or had it meanwhile */
            struct epoll_event event = {.events = EPOLLIN, .data.ptr = link};
            link->is_limited = 0;
            epoll_ctl(passage->epoll, EPOLL_CTL_ADD, link->fd, &event);
        }
        pthread_mutex_unlock(&link->reading);
        if (reads_on)
            ask_for_turn(passage, link);
    }
    return least_ns < 0 ? -1 : (int)(least_ns / 1000000 + 1);
}

/* Let the link have its turn that has used the least time. */
static void take_turn(Passage *passage)
{
    Link *link = passage->waiting;
    if (!link)
        return;
    passage->waiting = link->next_waiting;
    passage->turn_ns = link->turn_ns;
    atomic_store_explicit(&link->waits, 0, memory_order_relaxed);
    int is_inside, more = read_link(link, clock_ns(CLOCK_MONOTONIC), &is_inside);
    int64_t before_ns = passage->used_ns;
    passage->used_ns = clock_ns(CLOCK_THREAD_CPUTIME_ID);
    link->turn_ns += (passage->used_ns - before_ns) / (more || is_inside ? 1 : PART);
    if (more)
        ask_for_turn(passage, link);
}

#endif
