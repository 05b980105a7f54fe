/* Publishers of ROS topics. */
#ifndef IGTL_GATEWAY_PASSAGE_PUBLISHING_H
#define IGTL_GATEWAY_PASSAGE_PUBLISHING_H

#include "_sequence.h"

#define REMEMBERED 64        /* own messages of a latched topic: more than a late subscription gets of them */
#define REMEMBERED_BYTES 256 /* of their beginning, as in edges/ros/topics.py */

/* How a message begins that was published, and when it was (UTC ns). */
struct own_message {
    int64_t begun_ns, ended_ns;
    ssize_t whole, size; /* size: of ``bytes`` */
    uint8_t bytes[REMEMBERED_BYTES];
};

typedef struct {
    PyObject_HEAD
    const void *pointer; /* rcl_publisher_t; NULL: nothing is published */
    long long published, unheard, failed;
    char latched;          /* a later subscription of our own node might get its last messages */
    _Atomic char by_python; /* its messages are Python's */
    pthread_mutex_t publishing;       /* guards what follows, in a latched one, until the end of each call is known */
    struct own_message *own_messages; /* of a latched one: the last REMEMBERED that Python has not taken over */
    uint64_t begun, taken_over, measured; /* numbers of own messages so far */
} Publisher;

static int has_subscriber(Passage *self, Publisher *publisher)
{
    size_t subscribers = 0;
    return self->subscribers(publisher->pointer, &subscribers) == RCL_RET_OK && subscribers > 0;
}

static void publish(Passage *self, Publisher *publisher, uint8_t *cdr, ssize_t size)
{
    struct rcl_serialized message = {.buffer = cdr, .length = (size_t)size, .capacity = (size_t)size};
    struct own_message *own = NULL;
    if (publisher->latched) {
        pthread_mutex_lock(&publisher->publishing);
        own = &publisher->own_messages[publisher->begun++ % REMEMBERED];
        own->whole = size, own->size = size < REMEMBERED_BYTES ? size : REMEMBERED_BYTES;
        memcpy(own->bytes, cdr, (size_t)own->size);
        own->begun_ns = clock_ns(CLOCK_REALTIME);
    }
    if (self->publish(publisher->pointer, &message, NULL) == RCL_RET_OK)
        add(&publisher->published);
    else
        add(&publisher->failed);
    if (own) {
        own->ended_ns = clock_ns(CLOCK_REALTIME);
        pthread_mutex_unlock(&publisher->publishing);
    }
}

#endif
