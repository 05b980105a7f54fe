/* An arm of cisst behind the OpenIGTLink server of sawOpenIGTLink, for tools/judges/cisst.py.
 *
 * `crtk_arm PORT` sends what cisst.py computes, too: the number of a message is in its stamp.  Each command that arrives is
 * a line of JSON.  It ends with its standard input.
 */
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <string>
#include <vector>

#include <cisstMultiTask/mtsInterfaceProvided.h>
#include <cisstMultiTask/mtsManagerLocal.h>
#include <cisstMultiTask/mtsTaskPeriodic.h>
#include <cisstParameterTypes/prmEventButton.h>
#include <cisstParameterTypes/prmForceCartesianGet.h>
#include <cisstParameterTypes/prmForceCartesianSet.h>
#include <cisstParameterTypes/prmPositionCartesianGet.h>
#include <cisstParameterTypes/prmPositionCartesianSet.h>
#include <cisstParameterTypes/prmPositionJointSet.h>
#include <cisstParameterTypes/prmStateJoint.h>
#include <cisstParameterTypes/prmVelocityCartesianGet.h>
#include <cisstVector/vctAxisAngleRotation3.h>
#include <cisstVector/vctMatrixRotation3.h>

#include <igtlNDArrayMessage.h>
#include <igtlPointMessage.h>
#include <igtlSensorMessage.h>
#include <igtlStringMessage.h>
#include <igtlTransformMessage.h>

#include <sawOpenIGTLink/mtsCISSTToIGTL.h>
#include <sawOpenIGTLink/mtsIGTLCRTKBridge.h>
#include <sawOpenIGTLink/mtsIGTLToCISST.h>

namespace {

const double PERIOD_S = 0.02;
const int JOINTS = 3;
const int INVALID = 5; // each fifth setpoint is not valid
const char *INTERFACE = "PSM1";

double stamp(int number) { return 1700000000.0 + number / 4.0; }

void print(const char *name, const std::vector<double> &values)
{
    std::printf("{\"command\": \"%s\", \"values\": [", name);
    for (size_t i = 0; i < values.size(); i++)
        std::printf("%s%.17g", i ? ", " : "", values[i]);
    std::printf("]}\n");
    std::fflush(stdout);
}

void print_text(const char *name, const std::string &text)
{
    std::printf("{\"command\": \"%s\", \"text\": \"%s\"}\n", name, text.c_str());
    std::fflush(stdout);
}

class Arm : public mtsTaskPeriodic {
public:
    Arm() : mtsTaskPeriodic("arm", PERIOD_S)
    {
        mtsInterfaceProvided *arm = AddInterfaceProvided(INTERFACE);
        arm->AddMessageEvents();
        arm->AddCommandRead(&Arm::measured_cp, this, "measured_cp");
        arm->AddCommandRead(&Arm::setpoint_cp, this, "setpoint_cp");
        arm->AddCommandRead(&Arm::measured_js, this, "measured_js");
        arm->AddCommandRead(&Arm::setpoint_js, this, "setpoint_js");
        arm->AddCommandRead(&Arm::measured_cv, this, "measured_cv");
        arm->AddCommandRead(&Arm::measured_cf, this, "measured_cf");
        arm->AddCommandRead(&Arm::tip, this, "tip");
        arm->AddCommandRead(&Arm::note, this, "note");
        arm->AddCommandWrite(&Arm::servo_cp, this, "servo_cp");
        arm->AddCommandWrite(&Arm::move_cp, this, "move_cp");
        arm->AddCommandWrite(&Arm::servo_jp, this, "servo_jp");
        arm->AddCommandWrite(&Arm::servo_jr, this, "servo_jr");
        arm->AddCommandWrite(&Arm::move_jp, this, "move_jp");
        arm->AddCommandWrite(&Arm::move_jr, this, "move_jr");
        arm->AddCommandWrite(&Arm::servo_cf, this, "servo_cf");
        arm->AddCommandWrite(&Arm::state_command, this, "state_command");
        arm->AddCommandWrite(&Arm::aim, this, "aim");
        arm->AddCommandWrite(&Arm::label, this, "label");
        mtsInterfaceProvided *clutch = AddInterfaceProvided("PSM1-clutch");
        clutch->AddEventWrite(press, "Button", prmEventButton());
    }

    void Configure(const std::string &) override {}
    void Startup(void) override {}
    void Cleanup(void) override {}

    void Run(void) override
    {
        ProcessQueuedCommands();
        if (++turns % 5)
            return;
        const int number = turns / 5;
        mtsInterfaceProvided *arm = GetInterfaceProvided(INTERFACE);
        const std::string text = std::to_string(number);
        arm->SendStatus("status " + text);
        arm->SendWarning("warning " + text);
        arm->SendError("error " + text);
        const prmEventButton::EventType kinds[3] = {prmEventButton::PRESSED, prmEventButton::RELEASED, prmEventButton::CLICKED};
        prmEventButton button(kinds[number % 3]);
        button.Timestamp() = stamp(number);
        button.SetValid(true);
        press(button);
    }

private:
    mtsFunctionWrite press;
    int turns = 0;
    mutable int cp = 0, setpoint = 0, js = 0, setpoint_joints = 0, cv = 0, cf = 0, tips = 0, notes = 0;

    template <class Value> static void finish(Value &value, int number)
    {
        value.Timestamp() = stamp(number);
        value.SetValid(true);
    }

    static void pose(prmPositionCartesianGet &value, int number)
    {
        const vctAxAnRot3 turn(vct3(1.0 / 3, 2.0 / 3, 2.0 / 3), 0.05 * number, VCT_NORMALIZE);
        value.Position().Rotation().From(turn);
        value.Position().Translation().Assign(0.001 * number, -0.25, 0.5 + 0.002 * number);
        finish(value, number);
    }

    void measured_cp(prmPositionCartesianGet &value) const { pose(value, ++cp); }

    void setpoint_cp(prmPositionCartesianGet &value) const
    {
        pose(value, ++setpoint);
        value.SetValid(setpoint % INVALID != 0);
    }

    void measured_js(prmStateJoint &value) const
    {
        const int number = ++js;
        value.SetSize(JOINTS);
        for (int joint = 0; joint < JOINTS; joint++) {
            value.Name()[joint] = "joint " + std::to_string(joint);
            value.Position()[joint] = 0.1 * number + joint;
            value.Velocity()[joint] = -0.2 * number + joint;
            value.Effort()[joint] = 0.3 * number - joint;
        }
        finish(value, number);
    }

    void setpoint_js(prmStateJoint &value) const
    {
        const int number = ++setpoint_joints;
        value.Name().resize(JOINTS);
        value.Position().SetSize(JOINTS);
        for (int joint = 0; joint < JOINTS; joint++)
            value.Position()[joint] = 0.1 * number + joint;
        finish(value, number);
    }

    void measured_cv(prmVelocityCartesianGet &value) const
    {
        const int number = ++cv;
        value.SetVelocityLinear(vct3(0.01 * number, 0.02 * number, 0.03 * number));
        value.SetVelocityAngular(vct3(0.1 * number, -0.2 * number, 0.3 * number));
        finish(value, number);
    }

    void measured_cf(prmForceCartesianGet &value) const
    {
        const int number = ++cf;
        for (int i = 0; i < 6; i++)
            value.Force()[i] = 0.25 * number + i;
        finish(value, number);
    }

    void tip(vct3 &value) const { value.Assign(++tips, -7.5, 100.25); }

    void note(std::string &value) const { value = "note " + std::to_string(++notes); }

    static std::vector<double> numbers(const prmPositionCartesianSet &value)
    {
        std::vector<double> found;
        for (int row = 0; row < 3; row++)
            for (int column = 0; column < 3; column++)
                found.push_back(value.Goal().Rotation().Element(row, column));
        for (int axis = 0; axis < 3; axis++)
            found.push_back(value.Goal().Translation().Element(axis));
        return found;
    }

    template <class Vector> static std::vector<double> all(const Vector &value) { return {value.begin(), value.end()}; }

    void servo_cp(const prmPositionCartesianSet &value) { print("servo_cp", numbers(value)); }
    void move_cp(const prmPositionCartesianSet &value) { print("move_cp", numbers(value)); }
    void servo_jp(const prmPositionJointSet &value) { print("servo_jp", all(value.Goal())); }
    void servo_jr(const prmPositionJointSet &value) { print("servo_jr", all(value.Goal())); }
    void move_jp(const prmPositionJointSet &value) { print("move_jp", all(value.Goal())); }
    void move_jr(const prmPositionJointSet &value) { print("move_jr", all(value.Goal())); }
    void servo_cf(const prmForceCartesianSet &value) { print("servo_cf", all(value.Force())); }
    void state_command(const std::string &value) { print_text("state_command", value); }
    void aim(const vct3 &value) { print("aim", all(value)); }
    void label(const std::string &value) { print_text("label", value); }
};

} // namespace

int main(int count, char **words)
{
    if (count != 2)
        return 2;
    mtsComponentManager *manager = mtsComponentManager::GetInstance();
    Arm *arm = new Arm;
    manager->AddComponent(arm);
    mtsIGTLCRTKBridge *bridge = new mtsIGTLCRTKBridge("bridge", PERIOD_S);
    bridge->SetPort(std::atoi(words[1]));
    bridge->BridgeInterfaceProvided("arm", INTERFACE, INTERFACE);
    const std::string there = std::string("arm::") + INTERFACE;
    bridge->AddSenderFromCommandRead<vct3, igtl::PointMessage>(there, "tip", "Tip");
    bridge->AddSenderFromCommandRead<std::string, igtl::StringMessage>(there, "note", "Note");
    bridge->AddReceiverToCommandWrite<igtl::PointMessage, vct3>(there, "aim", "Aim");
    bridge->AddReceiverToCommandWrite<igtl::StringMessage, std::string>(there, "label", "Label");
    manager->AddComponent(bridge);
    bridge->Connect();
    manager->CreateAll();
    manager->WaitForStateAll(mtsComponentState::READY);
    manager->StartAll();
    while (std::getchar() != EOF)
        ;
    std::_Exit(0);
}
