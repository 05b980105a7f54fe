/* The compiled part of igtl_gateway/record/sessionfile/entry_counts.py, which documents the type.
 *
 * It also exists there in Python, with an equal result.  The bytes are those of the writer itself; nothing is read
 * beyond them all the same.
 */
#define PY_SSIZE_T_CLEAN
#define _GNU_SOURCE /* memmem */
#include <Python.h>
#include <stdint.h>
#include <string.h>

#include "kernel/_records.h"

#if __BYTE_ORDER__ != __ORDER_LITTLE_ENDIAN__
#error "this part reads numbers as they are in memory"
#endif

/* As in entry_counts.py. */
#define CHANNELS (1 << 16)
#define MOST_AGES 100000
#define MOST_AGES_OF_ALL (4 << 20)
#define MOST_STREAMS 10000
#define MOST_LINKS 1000
#define FAR_NS (1LL << 62)
#define FAR_AHEAD_NS (1LL << 60)

/* As in gateway/log/timing.py. */
#define NS_PER_MS 1000000LL
#define NS_PER_S 1000000000LL
#define FUTURE_NS (100 * NS_PER_MS)
#define BLOCK_NS (10 * NS_PER_S)
#define ON_STEP_NS 500
#define STEPS 4
static const int64_t step_ns[STEPS] = {NS_PER_S, 100 * NS_PER_MS, 10 * NS_PER_MS, NS_PER_MS};

static const char mark[] = "clock_step";

#define UNKNOWN (-1)
#define NOTES (-2)

/* The estimate of a sender's clock: StampTiming. */
struct clock {
    uint32_t link, name;
    int64_t messages, unset, future, backwards, repeated, least, most, excess;
    int64_t previous, block_end, block_least;
    int64_t first[2], last[2]; /* end and minimum of a block */
    int has_block;
    int steps; /* a bit for each of step_ns */
};

/* A link of a stream, and the number of its clock; -1: none yet. */
struct link {
    uint32_t number;
    int32_t clock;
};

struct stream {
    uint32_t name;
    int is_input, is_wire;
    int64_t messages, bytes, first, last, pause, unstamped;
    int64_t *ages;
    struct link *links;
    int32_t age_count, age_room, link_count, link_room, hit;
    int32_t clock; /* of messages without links; -1: none yet */
};

typedef struct {
    PyObject_HEAD
    int32_t *channels; /* by number: stream, UNKNOWN or NOTES */
    struct stream *streams;
    struct clock *clocks;
    int32_t stream_count, stream_room, clock_count, clock_room;
    int64_t ahead, age_count;
    int good;
} Counts;

/* Room for one more element; 0 without memory. */
static int has_room(void **items, int32_t *room, int32_t count, size_t size)
{
    if (count < *room)
        return 1;
    const int32_t more = *room ? 2 * *room : 8;
    void *larger = PyMem_Realloc(*items, (size_t)more * size);
    if (!larger)
        return 0;
    *items = larger;
    *room = more;
    return 1;
}

static void release(Counts *self)
{
    for (int32_t i = 0; i < self->stream_count; i++) {
        PyMem_Free(self->streams[i].ages);
        PyMem_Free(self->streams[i].links);
    }
    PyMem_Free(self->streams);
    PyMem_Free(self->clocks);
    self->streams = NULL;
    self->clocks = NULL;
    self->stream_count = self->stream_room = self->clock_count = self->clock_room = 0;
}

/* -- clocks ------------------------------------------------------------------------------------------------------- */

/* Look at a stamp; 0 where the sum of the excess does not fit. */
static int add_stamp(struct clock *clock, int64_t stamp, int64_t arrival)
{
    clock->messages++;
    if (stamp <= 0) {
        clock->unset++;
        return 1;
    }
    const int64_t age = arrival - stamp;
    clock->future += age < -FUTURE_NS;
    for (int i = 0; clock->steps && i < STEPS; i++) {
        const int64_t rest = stamp % step_ns[i];
        if ((rest < step_ns[i] - rest ? rest : step_ns[i] - rest) > ON_STEP_NS)
            clock->steps &= ~(1 << i);
    }
    clock->repeated += stamp == clock->previous;
    clock->backwards += stamp < clock->previous;
    if (!clock->previous) {
        clock->least = clock->most = clock->block_least = age;
        clock->block_end = arrival + BLOCK_NS;
    } else if (arrival >= clock->block_end) {
        clock->last[0] = clock->block_end;
        clock->last[1] = clock->block_least;
        if (!clock->has_block)
            memcpy(clock->first, clock->last, sizeof clock->first);
        clock->has_block = 1;
        clock->block_least = age;
        clock->block_end = arrival + BLOCK_NS;
    }
    clock->previous = stamp;
    clock->least = age < clock->least ? age : clock->least;
    clock->most = age > clock->most ? age : clock->most;
    clock->block_least = age < clock->block_least ? age : clock->block_least;
    int64_t above;
    return !__builtin_sub_overflow(age, clock->block_least, &above) &&
           !__builtin_add_overflow(clock->excess, above, &clock->excess);
}

/* The number of the clock of a link by a name; -1: there is no room for it. */
static int32_t clock_of(Counts *self, uint32_t link, uint32_t name)
{
    for (int32_t i = 0; i < self->clock_count; i++)
        if (self->clocks[i].link == link && self->clocks[i].name == name)
            return i;
    if (self->clock_count >= MOST_STREAMS ||
        !has_room((void **)&self->clocks, &self->clock_room, self->clock_count, sizeof *self->clocks))
        return -1;
    self->clocks[self->clock_count] = (struct clock){.link = link, .name = name, .steps = (1 << STEPS) - 1};
    return self->clock_count++;
}

/* -- streams ------------------------------------------------------------------------------------------------------ */

/* The link of a stream; NULL: there is no room for it. */
static struct link *link_of(struct stream *stream, uint32_t number)
{
    if (stream->hit < stream->link_count && stream->links[stream->hit].number == number)
        return &stream->links[stream->hit];
    for (int32_t i = 0; i < stream->link_count; i++)
        if (stream->links[i].number == number)
            return &stream->links[stream->hit = i];
    if (stream->link_count >= MOST_LINKS ||
        !has_room((void **)&stream->links, &stream->link_room, stream->link_count, sizeof *stream->links))
        return NULL;
    stream->hit = stream->link_count;
    stream->links[stream->link_count] = (struct link){.number = number, .clock = -1};
    return &stream->links[stream->link_count++];
}

/* Look at an input: the age of its stamp, and the clock of its first link (0: ROS, or none). */
static int add_input(Counts *self, struct stream *stream, int32_t *clock, uint32_t link, int64_t time, int64_t source)
{
    if (!source) {
        stream->unstamped++;
    } else if (stream->age_count < MOST_AGES) {
        if (self->age_count++ >= MOST_AGES_OF_ALL ||
            !has_room((void **)&stream->ages, &stream->age_room, stream->age_count, sizeof *stream->ages))
            return 0;
        stream->ages[stream->age_count++] = time - self->ahead - source;
    }
    if (*clock < 0)
        *clock = clock_of(self, link, stream->name);
    return *clock >= 0 && add_stamp(&self->clocks[*clock], source, time - self->ahead);
}

/* The size of the payload of a RawMessage, of which ``size`` bytes are here; -1: its fields are not in them. */
static int64_t raw_size(const uint8_t *raw, size_t size)
{
    size_t at = RAW_HEAD;
    if (size < at + 4)
        return -1;
    const uint64_t links = record_u32(raw + at);
    at += 4;
    if (links > (size - at) / 4)
        return -1;
    at += 4 * (size_t)links;
    for (int i = 0; i < 2; i++) { /* type and device name */
        if (size - at < 4)
            return -1;
        const size_t length = record_u32(raw + at);
        at += 4;
        if (length > size - at)
            return -1;
        at = (at + length + 3) & ~(size_t)3;
        if (at > size)
            return -1;
    }
    return size - at < 4 ? -1 : (int64_t)record_u32(raw + at);
}

/* Count a message, of which ``size`` of ``length`` bytes are here. */
static int add_message(Counts *self, struct stream *stream, const uint8_t *payload, size_t size, uint64_t length,
                       int64_t time, int64_t publish)
{
    int stamped = publish != time;
    int64_t bytes = (int64_t)length;
    uint32_t links = 0;
    if (stream->is_wire) {
        bytes = raw_size(payload, size);
        if (bytes < 0)
            return 0;
        stamped = stamped || record_u64(payload + RAW_SOURCE_AT);
        links = record_u32(payload + RAW_HEAD);
    }
    if (stream->messages) {
        const int64_t pause = time - stream->last;
        stream->pause = pause > stream->pause ? pause : stream->pause;
    } else {
        stream->first = time;
    }
    stream->last = time;
    stream->messages++;
    stream->bytes += bytes;
    uint32_t number = 0;
    struct link *first = NULL;
    for (uint32_t i = links; i-- > 0;) {
        number = record_u32(payload + RAW_HEAD + 4 + 4 * (size_t)i);
        if (!(first = link_of(stream, number)))
            return 0;
    }
    if (!stream->is_input)
        return 1;
    return add_input(self, stream, first ? &first->clock : &stream->clock, number, time, stamped ? publish : 0);
}

/* -- methods ------------------------------------------------------------------------------------------------------ */

static PyObject *begin_file(PyObject *object, PyObject *unused)
{
    (void)unused;
    Counts *self = (Counts *)object;
    memset(self->channels, 0xff, CHANNELS * sizeof *self->channels);
    Py_RETURN_NONE;
}

static PyObject *add_stream(PyObject *object, PyObject *args)
{
    Counts *self = (Counts *)object;
    unsigned int name;
    int is_input, is_wire;
    if (!PyArg_ParseTuple(args, "Ipp", &name, &is_input, &is_wire))
        return NULL;
    if (self->stream_count >= MOST_STREAMS) {
        self->good = 0;
        return PyLong_FromLong(UNKNOWN);
    }
    if (!has_room((void **)&self->streams, &self->stream_room, self->stream_count, sizeof *self->streams))
        return PyErr_NoMemory();
    self->streams[self->stream_count] =
        (struct stream){.name = name, .is_input = is_input, .is_wire = is_wire, .clock = -1};
    return PyLong_FromLong(self->stream_count++);
}

static PyObject *set_channel(PyObject *object, PyObject *args)
{
    Counts *self = (Counts *)object;
    int number, stream;
    if (!PyArg_ParseTuple(args, "ii", &number, &stream))
        return NULL;
    if (number < 0 || number >= CHANNELS || stream < NOTES || stream >= self->stream_count) {
        PyErr_SetString(PyExc_ValueError, "set_channel: found another number, expected that of a stream");
        return NULL;
    }
    self->channels[number] = stream;
    Py_RETURN_NONE;
}

static PyObject *give_up(PyObject *object, PyObject *unused)
{
    (void)unused;
    Counts *self = (Counts *)object;
    self->good = 0;
    release(self);
    memset(self->channels, 0xff, CHANNELS * sizeof *self->channels);
    Py_RETURN_NONE;
}

/* (chunk, at) -> the place of a note to look into; -1: all was counted */
static PyObject *add(PyObject *object, PyObject *args)
{
    Counts *self = (Counts *)object;
    Py_buffer view;
    Py_ssize_t place, found = -1;
    if (!PyArg_ParseTuple(args, "y*n", &view, &place))
        return NULL;
    const uint8_t *chunk = view.buf;
    const size_t size = (size_t)view.len;
    size_t at = place < 0 ? size : (size_t)place;
    while (self->good && at < size && size - at >= RECORD_HEAD + MESSAGE_HEAD) {
        const uint8_t *record = chunk + at, *payload = record + RECORD_HEAD + MESSAGE_HEAD;
        const uint64_t length = record_u64(record + 1);
        const size_t here = size - at - RECORD_HEAD;
        const size_t begin = at;
        at = length > here ? size : at + RECORD_HEAD + (size_t)length;
        if (record[0] != MESSAGE)
            continue;
        uint16_t channel;
        memcpy(&channel, record + RECORD_HEAD, 2);
        const int32_t number = self->channels[channel];
        const uint64_t time = record_u64(record + RECORD_HEAD + TIME_AT);
        const uint64_t publish = record_u64(record + RECORD_HEAD + PUBLISH_AT);
        if (number == UNKNOWN || length < MESSAGE_HEAD || time >= FAR_NS || publish >= FAR_NS) {
            self->good = 0;
        } else if (number == NOTES) {
            if (length > here || memmem(payload, (size_t)length - MESSAGE_HEAD, mark, sizeof mark - 1)) {
                found = (Py_ssize_t)begin;
                break;
            }
        } else {
            const size_t most = (length > here ? here : (size_t)length) - MESSAGE_HEAD;
            self->good = add_message(self, &self->streams[number], payload, most, length - MESSAGE_HEAD,
                                     (int64_t)time, (int64_t)publish);
        }
    }
    PyBuffer_Release(&view);
    if (!self->good)
        return give_up(object, NULL) ? PyLong_FromLong(-1) : NULL;
    return PyLong_FromSsize_t(found);
}

static PyObject *step(PyObject *object, PyObject *args)
{
    Counts *self = (Counts *)object;
    long long jump, ahead, at;
    if (!PyArg_ParseTuple(args, "LLL", &jump, &ahead, &at))
        return NULL;
    if (ahead <= -FAR_AHEAD_NS || ahead >= FAR_AHEAD_NS || jump < 0 || jump >= FAR_AHEAD_NS)
        return give_up(object, NULL);
    self->ahead = ahead;
    const int64_t before = at - jump;
    for (int32_t i = 0; jump && i < self->stream_count; i++) {
        struct stream *stream = &self->streams[i];
        if (!stream->first)
            continue;
        if (stream->last <= before) {
            stream->first += jump;
            stream->last += jump;
        } else if (stream->first <= before) {
            stream->first += jump;
            if (stream->pause >= jump)
                stream->pause -= jump;
        }
        if (stream->last >= FAR_NS)
            return give_up(object, NULL);
    }
    for (int32_t i = 0; i < self->clock_count; i++) {
        self->clocks[i].previous = 0;
        self->clocks[i].has_block = 0;
    }
    Py_RETURN_NONE;
}

/* The element of rank ``rank``; the ages are put in another order. */
static int64_t nth_age(int64_t *ages, int32_t count, int32_t rank)
{
    int32_t low = 0, high = count - 1;
    uint32_t chance = 1;
    while (low < high) {
        chance = chance * 1664525u + 1013904223u;
        const int64_t pivot = ages[low + (int32_t)(chance % (uint32_t)(high - low + 1))];
        int32_t one = low, two = high;
        while (one <= two) {
            while (ages[one] < pivot)
                one++;
            while (ages[two] > pivot)
                two--;
            if (one <= two) {
                const int64_t age = ages[one];
                ages[one++] = ages[two];
                ages[two--] = age;
            }
        }
        if (rank <= two)
            high = two;
        else if (rank >= one)
            low = one;
        else
            break;
    }
    return ages[rank];
}

/* [median, largest less smallest] of the ages; None without any */
static PyObject *ages_of(struct stream *stream)
{
    if (!stream->age_count)
        Py_RETURN_NONE;
    int64_t least = stream->ages[0], most = least;
    for (int32_t i = 1; i < stream->age_count; i++) {
        least = stream->ages[i] < least ? stream->ages[i] : least;
        most = stream->ages[i] > most ? stream->ages[i] : most;
    }
    PyObject *one = PyLong_FromLongLong(least), *two = PyLong_FromLongLong(most);
    PyObject *range = one && two ? PyNumber_Subtract(two, one) : NULL;
    Py_XDECREF(one);
    Py_XDECREF(two);
    if (!range)
        return NULL;
    return Py_BuildValue("[LN]", (long long)nth_age(stream->ages, stream->age_count, stream->age_count / 2), range);
}

static PyObject *stream_row(struct stream *stream)
{
    PyObject *links = PyList_New(stream->link_count);
    PyObject *ages = links ? ages_of(stream) : NULL;
    for (int32_t i = 0; ages && i < stream->link_count; i++) {
        PyObject *number = PyLong_FromUnsignedLong(stream->links[i].number);
        if (!number)
            Py_CLEAR(ages);
        else
            PyList_SET_ITEM(links, i, number);
    }
    if (!ages || PyList_Sort(links) < 0) {
        Py_XDECREF(ages);
        Py_XDECREF(links);
        return NULL;
    }
    return Py_BuildValue("[LLLLLLNN]", (long long)stream->messages, (long long)stream->bytes,
                         (long long)stream->first, (long long)stream->last, (long long)stream->pause,
                         (long long)stream->unstamped, ages, links);
}

static PyObject *block_row(const struct clock *clock, const int64_t *block)
{
    if (!clock->has_block)
        Py_RETURN_NONE;
    return Py_BuildValue("[LL]", (long long)block[0], (long long)block[1]);
}

static PyObject *clock_row(const struct clock *clock)
{
    return Py_BuildValue("[IILLLLLLLLiNN]", clock->link, clock->name, (long long)clock->messages,
                         (long long)clock->unset, (long long)clock->future, (long long)clock->backwards,
                         (long long)clock->repeated, (long long)clock->least, (long long)clock->most,
                         (long long)clock->excess, clock->steps, block_row(clock, clock->first),
                         block_row(clock, clock->last));
}

static PyObject *streams(PyObject *object, PyObject *unused)
{
    (void)unused;
    Counts *self = (Counts *)object;
    PyObject *rows = PyList_New(0);
    for (int32_t i = 0; rows && i < self->stream_count; i++) {
        PyObject *row = stream_row(&self->streams[i]);
        if (!row || PyList_Append(rows, row) < 0)
            Py_CLEAR(rows);
        Py_XDECREF(row);
    }
    return rows;
}

static PyObject *clocks(PyObject *object, PyObject *unused)
{
    (void)unused;
    Counts *self = (Counts *)object;
    PyObject *rows = PyList_New(0);
    for (int32_t i = 0; rows && i < self->clock_count; i++) {
        PyObject *row = clock_row(&self->clocks[i]);
        if (!row || PyList_Append(rows, row) < 0)
            Py_CLEAR(rows);
        Py_XDECREF(row);
    }
    return rows;
}

static PyObject *get_good(PyObject *object, void *unused)
{
    (void)unused;
    return PyBool_FromLong(((Counts *)object)->good);
}

/* -- type --------------------------------------------------------------------------------------------------------- */

static PyObject *make(PyTypeObject *type, PyObject *args, PyObject *kwargs)
{
    (void)args;
    (void)kwargs;
    Counts *self = (Counts *)type->tp_alloc(type, 0);
    if (!self)
        return NULL;
    self->channels = PyMem_Malloc(CHANNELS * sizeof *self->channels);
    if (!self->channels) {
        Py_DECREF(self);
        return PyErr_NoMemory();
    }
    memset(self->channels, 0xff, CHANNELS * sizeof *self->channels);
    self->good = 1;
    return (PyObject *)self;
}

static void destroy(PyObject *object)
{
    release((Counts *)object);
    PyMem_Free(((Counts *)object)->channels);
    Py_TYPE(object)->tp_free(object);
}

static PyMethodDef methods[] = {
    {"begin_file", begin_file, METH_NOARGS, "See entry_counts.py."},
    {"add_stream", add_stream, METH_VARARGS, "See entry_counts.py."},
    {"set_channel", set_channel, METH_VARARGS, "See entry_counts.py."},
    {"give_up", give_up, METH_NOARGS, "See entry_counts.py."},
    {"add", add, METH_VARARGS, "See entry_counts.py."},
    {"step", step, METH_VARARGS, "See entry_counts.py."},
    {"streams", streams, METH_NOARGS, "See entry_counts.py."},
    {"clocks", clocks, METH_NOARGS, "See entry_counts.py."},
    {NULL, NULL, 0, NULL},
};

static PyGetSetDef properties[] = {
    {"good", get_good, NULL, "See entry_counts.py.", NULL},
    {NULL, NULL, NULL, NULL, NULL},
};

static PyTypeObject CountsType = {
    PyVarObject_HEAD_INIT(NULL, 0).tp_name = "igtl_gateway.native._figures.Counts",
    .tp_basicsize = sizeof(Counts),
    .tp_flags = Py_TPFLAGS_DEFAULT,
    .tp_doc = "See entry_counts.py.",
    .tp_new = make,
    .tp_dealloc = destroy,
    .tp_methods = methods,
    .tp_getset = properties,
};

static struct PyModuleDef definition = {PyModuleDef_HEAD_INIT, "_figures", "See entry_counts.py.", -1, NULL,
                                        NULL, NULL, NULL, NULL};

PyMODINIT_FUNC PyInit__figures(void)
{
    if (PyType_Ready(&CountsType) < 0)
        return NULL;
    PyObject *module = PyModule_Create(&definition);
    if (module && PyModule_AddObjectRef(module, "Counts", (PyObject *)&CountsType) < 0)
        Py_CLEAR(module);
    return module;
}
