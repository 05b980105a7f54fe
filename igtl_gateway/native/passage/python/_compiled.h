/* Compiled streams from Python: what `igtl_gateway.gateway.fastpath.passage_streams` copies. */
#ifndef IGTL_GATEWAY_PASSAGE_PYTHON_COMPILED_H
#define IGTL_GATEWAY_PASSAGE_PYTHON_COMPILED_H

#include "../../_places.h"
#include "_links.h"
#include "_publishers.h"
#include "_subscriptions.h"

static PyObject *passage_to_ros(Passage *self, PyObject *args)
{
    Link *link;
    const char *names, *sample;
    Py_ssize_t names_size, size, at, bytes, place_at;
    int check_crc, own;
    double times, by;
    unsigned long long number;
    PyObject *outputs;
    if (!PyArg_ParseTuple(args, "O!y#y#nnppddnKO!", Link_Type, &link, &names, &names_size, &sample, &size, &at, &bytes,
                          &check_crc, &own, &times, &by, &place_at, &number, &PyTuple_Type, &outputs))
        return NULL;
    if (names_size != NAMES_BYTES || (bytes != MATRIX_BYTES && bytes != QUATERNION_BYTES) || at < HEADER_SIZE ||
        at + bytes > size || (at + bytes < size && at < HEADER_SIZE + EXTENDED_SIZE) || place_at < at || place_at + 12 > size) {
        PyErr_SetString(PyExc_ValueError, "to_ros: numbers outside the sample");
        return NULL;
    }
    Stream *stream = new_stream(self, sample, size);
    if (!stream)
        return NULL;
    stream->link = (Link *)Py_NewRef((PyObject *)link);
    memcpy(stream->names, names, NAMES_BYTES);
    stream->from_igtl = (struct igtl_poses){stream->sample, size, at, bytes, check_crc, times, by};
    stream->own = own, stream->place_at = place_at, stream->number = number;
    set_metadata(stream, at + bytes, size - at - bytes);
    for (Py_ssize_t i = 0; i < PyTuple_GET_SIZE(outputs); i++) {
        const char *template;
        Py_ssize_t length, stamp_at, id_at;
        Publisher *publisher;
        if (!PyArg_ParseTuple(PyTuple_GET_ITEM(outputs, i), "y#nnKO!", &template, &length, &stamp_at, &id_at, &number,
                              Publisher_Type, &publisher))
            goto failed;
        if (!has_room_for_pose(length, stamp_at, id_at, at)) {
            PyErr_SetString(PyExc_ValueError, "to_ros: an output without room for stamp and pose or message id");
            goto failed;
        }
        struct output *output = new_output(stream, template, length, stamp_at, 0, number);
        if (!output)
            goto failed;
        output->id_at = id_at;
        output->publisher = (Publisher *)Py_NewRef((PyObject *)publisher);
    }
    return add_to_link(stream);
failed:
    Py_DECREF(stream);
    return NULL;
}

static PyObject *passage_to_ros_bulk(Passage *self, PyObject *args)
{
    Link *link;
    const char *names, *sample;
    Py_ssize_t names_size, size, at, tail;
    int check_crc, own, keeps;
    double times, by;
    unsigned long long number;
    PyObject *outputs;
    if (!PyArg_ParseTuple(args, "O!y#y#nnppddKO!p", Link_Type, &link, &names, &names_size, &sample, &size, &at, &tail,
                          &check_crc, &own, &times, &by, &number, &PyTuple_Type, &outputs, &keeps))
        return NULL;
    if (names_size != NAMES_BYTES || tail < 0 || (tail && sample[1] != 2) || size < at + tail ||
        (size - at - tail) % POINT_BYTES || at < HEADER_SIZE + (sample[1] == 2 ? EXTENDED_SIZE : 0)) {
        PyErr_SetString(PyExc_ValueError, "to_ros_bulk: a sample that is not all but the content");
        return NULL;
    }
    Stream *stream = new_stream(self, sample, size);
    if (!stream)
        return NULL;
    stream->link = (Link *)Py_NewRef((PyObject *)link);
    memcpy(stream->names, names, NAMES_BYTES);
    stream->is_bulk = 1;
    stream->bulk_from_igtl = (struct igtl_bulk){stream->sample, at, tail, check_crc, times, by, size - at - tail};
    stream->own = own, stream->number = number, stream->keeps = (char)keeps;
    set_metadata(stream, at, tail);
    for (Py_ssize_t i = 0; i < PyTuple_GET_SIZE(outputs); i++) {
        const char *template;
        Py_ssize_t room, stamp_at, width_at, rest;
        int form;
        Publisher *publisher;
        if (!PyArg_ParseTuple(PyTuple_GET_ITEM(outputs, i), "iy#nnnKO!", &form, &template, &room, &stamp_at, &width_at,
                              &rest, &number, Publisher_Type, &publisher))
            goto failed;
        struct output *output = new_output(stream, template, room, stamp_at, 0, number);
        if (!output)
            goto failed;
        output->form = (struct ros_form){.form = form, .template = output->template, .room = room, .stamp_at = stamp_at,
                                         .width_at = width_at, .rest = rest};
        if (form < TEXT || (form > PICTURE && form < TOOLS) || form > LANDMARKS || !has_room(&output->form) ||
            (form == METADATA && sample[1] != 2) || (form == LANDMARKS && size == at + tail)) {
            PyErr_SetString(PyExc_ValueError, "to_ros_bulk: a form without room for stamp and width");
            goto failed;
        }
        output->publisher = (Publisher *)Py_NewRef((PyObject *)publisher);
    }
    return add_to_link(stream);
failed:
    Py_DECREF(stream);
    return NULL;
}

/* Add the links that an output goes to; 0: an exception is set. */
static int add_links(struct output *output, const char *channel, PyObject *links)
{
    if (PyTuple_GET_SIZE(links) > MAX_LINKS) {
        PyErr_SetString(PyExc_ValueError, "to_igtl: more links than the passage has room for");
        return 0;
    }
    if (!(output->channel = strdup(channel))) {
        PyErr_NoMemory();
        return 0;
    }
    for (Py_ssize_t k = 0; k < PyTuple_GET_SIZE(links); k++) {
        PyObject *link = PyTuple_GET_ITEM(links, k);
        if (!PyObject_TypeCheck(link, Link_Type)) {
            PyErr_SetString(PyExc_TypeError, "to_igtl: not a link");
            return 0;
        }
        output->links[output->link_count++] = (Link *)Py_NewRef(link);
    }
    return 1;
}

static PyObject *passage_to_igtl(Passage *self, PyObject *args)
{
    Subscription *subscription;
    const char *sample;
    Py_ssize_t size, first_end, second, end, bytes;
    int own;
    double times, by;
    unsigned long long number;
    PyObject *outputs;
    if (!PyArg_ParseTuple(args, "O!y#nnnnpddKO!", Subscription_Type, &subscription, &sample, &size, &first_end, &second,
                          &end, &bytes, &own, &times, &by, &number, &PyTuple_Type, &outputs))
        return NULL;
    if (first_end < NAMES_AT || second < first_end || end < second || end > size - POSE_BYTES ||
        (bytes != MATRIX_BYTES && bytes != QUATERNION_BYTES)) {
        PyErr_SetString(PyExc_ValueError, "to_igtl: names outside the sample");
        return NULL;
    }
    Stream *stream = new_stream(self, sample, size);
    if (!stream)
        return NULL;
    stream->subscription = (Subscription *)Py_NewRef((PyObject *)subscription);
    stream->from_ros = (struct ros_poses){stream->sample, size, first_end, second, end, bytes, times, by};
    stream->own = own, stream->place_at = size - POSE_BYTES, stream->number = number;
    for (Py_ssize_t i = 0; i < PyTuple_GET_SIZE(outputs); i++) {
        const char *template, *channel;
        Py_ssize_t length, at, digits_at;
        PyObject *links;
        if (!PyArg_ParseTuple(PyTuple_GET_ITEM(outputs, i), "y#nnKsO!", &template, &length, &at, &digits_at, &number,
                              &channel, &PyTuple_Type, &links))
            goto failed;
        if (at < HEADER_SIZE || at + bytes > length || !has_digits(digits_at, length)) {
            PyErr_SetString(PyExc_ValueError, "to_igtl: an output without room for the numbers");
            goto failed;
        }
        struct output *output = new_output(stream, template, length, at, digits_at, number);
        if (!output || !add_links(output, channel, links))
            goto failed;
    }
    return set_stream(subscription, stream);
failed:
    Py_DECREF(stream);
    return NULL;
}

static PyObject *passage_to_igtl_bulk(Passage *self, PyObject *args)
{
    Subscription *subscription;
    const char *sample;
    Py_ssize_t size;
    int form, own;
    double times, by;
    unsigned long long number;
    PyObject *places, *outputs;
    if (!PyArg_ParseTuple(args, "O!y#O!ipddKO!", Subscription_Type, &subscription, &sample, &size, &PyTuple_Type, &places,
                          &form, &own, &times, &by, &number, &PyTuple_Type, &outputs))
        return NULL;
    Py_ssize_t count = PyTuple_GET_SIZE(places);
    if (form < TEXT || (form > BLUE_FIRST && form != TOOLS && form != NUMBERS) || form == POINT || count > MAX_PLACES || (form != TEXT && (count < 6 || count % 2))) {
        PyErr_SetString(PyExc_ValueError, "to_igtl_bulk: invalid form or places");
        return NULL;
    }
    Stream *stream = new_stream(self, sample, size);
    if (!stream)
        return NULL;
    stream->subscription = (Subscription *)Py_NewRef((PyObject *)subscription);
    stream->is_bulk = 1, stream->own = own, stream->number = number;
    struct ros_bulk *bulk = &stream->bulk_from_ros;
    *bulk = (struct ros_bulk){.sample = stream->sample, .size = size, .form = form, .times = times, .by = by};
    if (form != TEXT && !read_places(places, bulk, stream->places, count))
        goto failed;
    for (Py_ssize_t i = 0; i < PyTuple_GET_SIZE(outputs); i++) {
        const char *head, *tail, *channel;
        Py_ssize_t at, rest, digits_at;
        int keep;
        PyObject *links;
        if (!PyArg_ParseTuple(PyTuple_GET_ITEM(outputs, i), "y#y#nKspO!", &head, &at, &tail, &rest, &digits_at, &number,
                              &channel, &keep, &PyTuple_Type, &links))
            goto failed;
        if (at < HEADER_SIZE || !has_digits(digits_at, rest)) {
            PyErr_SetString(PyExc_ValueError, "to_igtl_bulk: an output without room for header or stamp");
            goto failed;
        }
        struct output *output = new_output(stream, head, at, at, digits_at, number);
        if (!output || !add_links(output, channel, links))
            goto failed;
        output->keep = (char)keep;
        output->tail_size = rest;
        if (!(output->tail = copied(tail, rest))) {
            PyErr_NoMemory();
            goto failed;
        }
    }
    return set_stream(subscription, stream);
failed:
    Py_DECREF(stream);
    return NULL;
}

#endif
