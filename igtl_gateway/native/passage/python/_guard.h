/* Guard, for Python. */
#ifndef IGTL_GATEWAY_PASSAGE_PYTHON_GUARD_H
#define IGTL_GATEWAY_PASSAGE_PYTHON_GUARD_H

#include "../_guard.h"
#include "_types.h"

#include <structmember.h>

static PyObject *guard_collect(Guard *guard, PyObject *nothing)
{
    (void)nothing;
    PyObject *found = NULL, *looks = PyList_New(guard->observed);
    PyObject *place = guard->has_place ? Py_BuildValue("ddd", guard->place[0], guard->place[1], guard->place[2])
                                       : Py_NewRef(Py_None);
    for (int i = 0; looks && i < guard->observed; i++)
        PyList_SET_ITEM(looks, i, Py_BuildValue("LL", (long long)guard->observations[i][0],
                                                (long long)guard->observations[i][1]));
    if (place && looks)
        found = Py_BuildValue("(LLLLLLO)O", (long long)guard->last_ns, (long long)guard->look_ns,
                              (long long)guard->due_ns, (long long)guard->seen_ns, (long long)guard->arrived_ns,
                              (long long)guard->still, place, looks);
    Py_XDECREF(place);
    Py_XDECREF(looks);
    if (found) {
        guard->observed = 0;
        guard->is_dirty = 0;
    }
    return found;
}

static PyObject *guard_set(Guard *guard, PyObject *args)
{
    int watches, judged, knows_age;
    long long max_age_ns, ahead_ns, last_ns, look_ns, due_ns, episode_ends_ns, seen_ns, arrived_ns, still;
    PyObject *place;
    if (!PyArg_ParseTuple(args, "pppLLLLLLLLLO", &watches, &judged, &knows_age, &max_age_ns, &ahead_ns, &last_ns, &look_ns,
                          &due_ns, &episode_ends_ns, &seen_ns, &arrived_ns, &still, &place))
        return NULL;
    guard->has_place = place != Py_None;
    if (guard->has_place && !PyArg_ParseTuple(place, "ddd", guard->place, guard->place + 1, guard->place + 2))
        return NULL;
    guard->watches = (char)watches, guard->judged_by_python = (char)judged, guard->knows_age = (char)knows_age;
    guard->max_age_ns = max_age_ns, guard->ahead_ns = ahead_ns, guard->last_ns = last_ns, guard->look_ns = look_ns;
    guard->due_ns = due_ns, guard->episode_ends_ns = episode_ends_ns, guard->seen_ns = seen_ns, guard->arrived_ns = arrived_ns, guard->still = still;
    Py_RETURN_NONE;
}

static PyObject *guard_passes(Guard *guard, PyObject *args)
{
    long long now_ns, stamp_ns;
    double place[3];
    if (PyTuple_GET_SIZE(args) == 2 ? !PyArg_ParseTuple(args, "LL", &now_ns, &stamp_ns)
                                    : !PyArg_ParseTuple(args, "LLddd", &now_ns, &stamp_ns, place, place + 1, place + 2))
        return NULL;
    return PyBool_FromLong(passes_guard(guard, now_ns, stamp_ns, PyTuple_GET_SIZE(args) == 2 ? NULL : place));
}

static PyMethodDef guard_methods[] = {
    {"passes", (PyCFunction)guard_passes, METH_VARARGS, "(time, stamp[, x, y, z]) -> whether it passes, for the tests."},
    {"collect", (PyCFunction)guard_collect, METH_NOARGS, "Return the state, and what was looked at since the last call."},
    {"set", (PyCFunction)guard_set, METH_VARARGS, "Set the state."},
    {NULL, NULL, 0, NULL},
};

static PyMemberDef guard_members[] = {
    {"is_dirty", T_BOOL, offsetof(Guard, is_dirty), READONLY, "Messages have changed it since the last collection."},
    {NULL, 0, 0, 0, NULL},
};

static PyType_Slot guard_slots[] = {
    {Py_tp_doc, "The state of a guarded stream; all methods need the sequence lock."},
    {Py_tp_dealloc, free_object},
    {Py_tp_new, PyType_GenericNew},
    {Py_tp_methods, guard_methods},
    {Py_tp_members, guard_members},
    {0, NULL},
};

static PyType_Spec guard_spec = {
    .name = "igtl_gateway.native._passage.Guard",
    .basicsize = sizeof(Guard),
    .flags = Py_TPFLAGS_DEFAULT | Py_TPFLAGS_IMMUTABLETYPE,
    .slots = guard_slots,
};

#endif
