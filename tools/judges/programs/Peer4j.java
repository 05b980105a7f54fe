// A peer on OpenIGTLink4J that sends what its standard input has and prints what it receives: see foreign_peers.py.

import java.io.BufferedReader;
import java.io.IOException;
import java.io.InputStreamReader;
import java.net.URLDecoder;
import java.net.URLEncoder;
import java.nio.charset.StandardCharsets;
import java.util.ArrayList;
import java.util.List;

import msg.OIGTL_DataMessage;
import msg.OIGTL_GetMessage;
import msg.OIGTL_RTSMessage;
import msg.OIGTL_STPMessage;
import msg.OIGTL_STTMessage;
import msg.OpenIGTMessage;
import msg.capability.CapabilityMessage;
import msg.image.CoordinateConvention;
import msg.image.ImageHeader;
import msg.image.ImageMessage;
import msg.image.ImageScalarType;
import msg.ndarray.NDArrayMessage;
import msg.point.PointElement;
import msg.point.PointMessage;
import msg.position.PositionMessage;
import msg.sensor.SensorMessage;
import msg.status.StatusMessage;
import msg.string.StringMessage;
import msg.track.TrackingInstrumentType;
import msg.track.tdata.STTTrackingDataMessage;
import msg.track.tdata.TrackingDataMessage;
import msg.track.tdata.TransformTrackingData;
import msg.transform.GetTransformMessage;
import msg.transform.Transform;
import msg.transform.TransformMessage;
import network.OpenIGTLinkClient;
import network.OpenIGTLinkServer;
import protocol.MessageParser;
import util.Endian;

public class Peer4j {
    interface Sender {
        void send(OpenIGTMessage message) throws IOException;
    }

    public static void main(String[] arguments) throws Exception {
        Sender sender;
        if (arguments[0].equals("client")) {
            OpenIGTLinkClient client = new OpenIGTLinkClient(arguments[1], Integer.parseInt(arguments[2]), new MessageParser(false)) {
                public void messageReceived(OpenIGTMessage message) { print(message); }
                public void rtsMesssageReceived(OIGTL_RTSMessage message, network.IOpenIGTMessageSender replyTo) { print(message); }
                public String[] getCapability() { return new String[0]; }
            };
            client.start();
            while (!client.isConnected()) Thread.sleep(10);
            sender = client::send;
        } else {
            OpenIGTLinkServer server = new OpenIGTLinkServer(Integer.parseInt(arguments[1]), new MessageParser(false)) {
                public void messageReceived(OpenIGTMessage message) { print(message); }
                public void rtsMesssageReceived(OIGTL_RTSMessage message, network.IOpenIGTMessageSender replyTo) { print(message); }
                public String[] getCapability() { return new String[0]; }
            };
            sender = server::send;
        }
        System.out.println("ready");
        BufferedReader input = new BufferedReader(new InputStreamReader(System.in, StandardCharsets.UTF_8));
        for (String line = input.readLine(); line != null; line = input.readLine()) {
            try {
                String[] words = line.split(" ");
                OpenIGTMessage message = made(words[0], text(words[1]), words);
                if (!words[2].equals("0")) {
                    message.getHeader().setTimeStamp_ms(Long.parseLong(words[2]) / 1000000);
                }
                sender.send(message);
            } catch (Exception error) {
                System.out.println("error =" + URLEncoder.encode(error.toString(), "UTF-8"));
            }
        }
        System.exit(0);
    }

    // words: type, device, stamp in ns, then those of the content

    static OpenIGTMessage made(String type, String device, String[] words) throws Exception {
        int at = 3;
        switch (type) {
            case "TRANSFORM": return new TransformMessage(device, floats(words, 12, 15), rows(words, 3));
            case "POSITION": return new PositionMessage(device, floats(words, 3, 6), floats(words, 6, 10));
            case "STRING": return new StringMessage(device, text(words[3]));
            case "STATUS": return new StatusMessage(device, number(words[3]), number(words[4]), text(words[5]), text(words[6]));
            case "IMAGE": {
                int[] size = {number(words[3]), number(words[4]), number(words[5])};
                ImageHeader head = new ImageHeader(number(words[7]), ImageScalarType.fromValue(number(words[6])), Endian.ENDIAN_LITTLE, CoordinateConvention.RAS, size,
                    floats(words, 10, 13), floats(words, 13, 16), floats(words, 16, 19), floats(words, 19, 22), new int[3], size);
                return new ImageMessage(device, head, bytes(words[22]));
            }
            case "SENSOR": {
                SensorMessage message = new SensorMessage(device);
                double[] values = new double[words.length - 4];
                for (int i = 0; i < values.length; i++) values[i] = Double.parseDouble(words[4 + i]);
                message.setLength((short) values.length);
                message.setUnit(new msg.sensor.Unit());
                message.setValue(values);
                return message;
            }
            case "POINT": {
                PointMessage message = new PointMessage(device);
                for (; at < words.length; at += 11) {
                    byte[] colour = new byte[4];
                    for (int i = 0; i < 4; i++) colour[i] = (byte) number(words[at + 2 + i]);
                    float[] place = floats(words, at + 6, at + 9);
                    message.addPointElement(new PointElement(text(words[at]), text(words[at + 1]), colour, place, Float.parseFloat(words[at + 9]), text(words[at + 10])));
                }
                return message;
            }
            case "TDATA": {
                TrackingDataMessage message = new TrackingDataMessage(device);
                for (; at < words.length; at += 14) {
                    Transform pose = new Transform(floats(words, at + 11, at + 14), rows(words, at + 2));
                    message.addTrackingData(new TransformTrackingData(text(words[at]), TrackingInstrumentType.fromValue(number(words[at + 1])), pose));
                }
                return message;
            }
            case "NDARRAY": return new NDArrayMessage(device, floats(words, 5, words.length));
            case "CAPABILITY": {
                CapabilityMessage message = new CapabilityMessage(device);
                for (; at < words.length; at++) message.addCapability(text(words[at]));
                return message;
            }
            case "STT_TDATA": return new STTTrackingDataMessage(device, number(words[3]));
            case "GET_TRANS": return new GetTransformMessage(device);
            default: throw new IllegalArgumentException("no class for " + type);
        }
    }

    static synchronized void print(OpenIGTMessage message) {
        try {
            List<Object> words = new ArrayList<>(List.of(message.getDataType(), quoted(message.getDeviceName()),
                message.getHeader().getTimeStamp(), message.getHeader().getTimeStampFrac(), message.getHeader().getVersion()));
            add(words, message);
            StringBuilder line = new StringBuilder();
            for (Object word : words) line.append(line.length() > 0 ? " " : "").append(word);
            System.out.println(line);
        } catch (Exception error) {
            System.out.println("error =" + error);
        }
    }

    static void add(List<Object> words, OpenIGTMessage got) throws Exception {
        if (got instanceof TransformMessage) {
            float[][] matrix;
            try {
                matrix = ((TransformMessage) got).getTransformMatrix();
            } catch (NullPointerException nothing) {
                words.add("null");
                return;
            }
            for (int column = 0; column < 4; column++) for (int row = 0; row < 3; row++) words.add(matrix[row][column]);
        } else if (got instanceof PositionMessage) {
            addAll(words, ((PositionMessage) got).getPosition());
            addAll(words, ((PositionMessage) got).getQuaternion());
        } else if (got instanceof StringMessage) {
            words.add(quoted(((StringMessage) got).getMessage()));
        } else if (got instanceof StatusMessage) {
            StatusMessage state = (StatusMessage) got;
            words.addAll(List.of(state.getCode(), state.getSubCode(), quoted(state.getErrorName()), quoted(state.getStatusString())));
        } else if (got instanceof ImageMessage) {
            ImageMessage image = (ImageMessage) got;
            for (int each : image.getDimensions()) words.add(each);
            words.addAll(List.of(image.getScalarType().code, image.getImageType(), image.getEndian().code, image.getImageCOSType().code));
            for (float[] axis : List.of(image.getNormals_i(), image.getNormals_j(), image.getNormals_k(), image.getOrigin())) addAll(words, axis);
            byte[] body = image.getBody();
            StringBuilder hex = new StringBuilder("=");
            for (int i = ImageHeader.SIZE; i < body.length; i++) hex.append(String.format("%02x", body[i]));
            words.add(hex);
        } else if (got instanceof SensorMessage) {
            for (double each : ((SensorMessage) got).getSensorValues()) words.add(each);
        } else if (got instanceof PointMessage) {
            words.add(((PointMessage) got).getPoints().getNumberOfElements());
            for (int i = 0; i < ((PointMessage) got).getPoints().getNumberOfElements(); i++)
                addAll(words, ((PointMessage) got).getPoints().getElement(i).getPosition());
        } else if (got instanceof TrackingDataMessage) {
            for (TransformTrackingData tool : ((TrackingDataMessage) got).getTrackingData()) {
                words.add(quoted(tool.getName()));
                words.add(tool.getType().code);
                float[][] matrix = tool.getTransform().getTransformMatrix();
                for (int column = 0; column < 4; column++) for (int row = 0; row < 3; row++) words.add(matrix[row][column]);
            }
        } else if (got instanceof NDArrayMessage) {
            addAll(words, ((NDArrayMessage) got).get1DFloatData());
        } else if (got instanceof CapabilityMessage) {
            for (String name : ((CapabilityMessage) got).GetCapabilityList()) words.add(quoted(name));
        }
    }

    static void addAll(List<Object> words, float[] values) {
        for (float each : values) words.add(each);
    }

    static int number(String word) { return (int) Long.parseLong(word); }

    static float[] floats(String[] words, int from, int to) {
        float[] values = new float[to - from];
        for (int i = 0; i < values.length; i++) values[i] = Float.parseFloat(words[from + i]);
        return values;
    }

    static float[][] rows(String[] words, int from) {  // the words have columns
        float[][] matrix = new float[3][3];
        for (int i = 0; i < 9; i++) matrix[i % 3][i / 3] = Float.parseFloat(words[from + i]);
        return matrix;
    }

    static byte[] bytes(String word) {
        byte[] found = new byte[(word.length() - 1) / 2];
        for (int i = 0; i < found.length; i++) found[i] = (byte) Integer.parseInt(word.substring(1 + 2 * i, 3 + 2 * i), 16);
        return found;
    }

    static String text(String word) throws Exception { return URLDecoder.decode(word.substring(1), "UTF-8"); }

    static String quoted(String text) throws Exception { return "=" + URLEncoder.encode(text == null ? "" : text, "UTF-8").replace("+", "%20"); }
}
